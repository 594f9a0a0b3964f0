"""Tone mapping and rectification: the built binary against numpy and OpenCV."""

import json
import os
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from sthn.tone import cut_points, tone_map

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def nightfix() -> Path:
    """The built binary: NIGHTFIX_BIN, else the debug build, else the release build."""
    named = os.environ.get("NIGHTFIX_BIN")
    candidates = [Path(named)] if named else [ROOT / "target" / kind / "nightfix" for kind in ("debug", "release")]
    for path in candidates:
        if path.is_file():
            return path
    pytest.skip(f"the binary is not built: none of {', '.join(map(str, candidates))}")


def run(nightfix: Path, frame: Path, out: Path, *options: str) -> tuple[np.ndarray, dict]:
    """The written picture and the report of `nightfix frame`."""
    done = subprocess.run([nightfix, "frame", frame, "--out", out, *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return cv2.imread(str(out), cv2.IMREAD_UNCHANGED), json.loads(done.stdout)


def by_sorting(frame: np.ndarray) -> np.ndarray:
    """The rule as it is written down, sample by sample."""
    ordered = np.sort(frame.ravel()).astype(int)
    k = ordered.size // 200
    lo, hi = int(ordered[k]), int(ordered[ordered.size - 1 - k])
    if hi - lo < 64:
        lo = (lo + hi - 64) // 2
        hi = lo + 64
    rule = [min(255, max(0, (510 * (int(v) - lo) + hi - lo) // (2 * (hi - lo)))) for v in frame.ravel()]
    return np.array(rule, np.uint8).reshape(frame.shape)


def random_frames() -> list[tuple[str, np.ndarray]]:
    """Frames of every kind the rule distinguishes."""
    rng = np.random.default_rng(1)
    scene = np.cumsum(np.cumsum(rng.normal(size=(96, 120)), 0), 1)
    scene = (scene - scene.min()) / np.ptp(scene)
    hot = (20_000 + 900 * scene).astype(np.uint16)
    hot.flat[rng.integers(0, hot.size, 40)] = 65_535
    hot.flat[rng.integers(0, hot.size, 40)] = 0
    return [
        ("any value", rng.integers(0, 65_536, (97, 131)).astype(np.uint16)),
        ("14 bit", (7_000 + 700 * scene).astype(np.uint16)),
        ("hot and dead pixels", hot),
        ("a narrow range", (30_000 + 20 * scene).astype(np.uint16)),
        ("an odd narrow range at the bottom", rng.integers(0, 6, (50, 50)).astype(np.uint16)),
        ("a narrow range at the top", rng.integers(65_500, 65_536, (50, 50)).astype(np.uint16)),
        ("constant", np.full((40, 40), 12_345, np.uint16)),
        ("two values", np.where(scene > 0.4, 5, 60_000).astype(np.uint16)),
        ("one pixel", np.array([[4242]], np.uint16)),
        ("199 pixels", rng.integers(0, 16_384, (1, 199)).astype(np.uint16)),
        ("200 pixels", rng.integers(0, 16_384, (1, 200)).astype(np.uint16)),
    ]


@pytest.mark.parametrize("name, frame", random_frames(), ids=[name for name, _ in random_frames()])
def test_rust_and_python_map_alike(nightfix: Path, tmp_path: Path, name: str, frame: np.ndarray):
    expected = tone_map(frame)
    np.testing.assert_array_equal(expected, by_sorting(frame))
    cv2.imwrite(str(tmp_path / "frame.png"), frame)
    cv2.imwrite(str(tmp_path / "frame.tiff"), frame)
    frame.astype("<u2").tofile(tmp_path / "frame.y16")
    size = ["--width", str(frame.shape[1]), "--height", str(frame.shape[0])]
    for file, options in [("frame.png", []), ("frame.tiff", size), ("frame.y16", size)]:
        found, report = run(nightfix, tmp_path / file, tmp_path / "out.png", "--tone-only", *options)
        np.testing.assert_array_equal(found, expected, err_msg=file)
        assert (report["bits"], report["width"], report["height"]) == (16, frame.shape[1], frame.shape[0])


def test_eight_bits_pass_unchanged(nightfix: Path, tmp_path: Path):
    frame = np.random.default_rng(2).integers(40, 60, (50, 70)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "frame.png"), frame)
    found, report = run(nightfix, tmp_path / "frame.png", tmp_path / "out.png", "--tone-only")
    np.testing.assert_array_equal(found, frame)
    np.testing.assert_array_equal(tone_map(frame), frame)
    assert report["bits"] == 8


def test_other_types_are_refused():
    with pytest.raises(TypeError, match="float64"):
        tone_map(np.zeros((4, 4)))


def test_real_frames_map_alike_and_use_the_whole_range(nightfix: Path, tmp_path: Path, shared: Path):
    files = sorted((shared / "flights" / "guangzhou" / "raw16").glob("*.png"))
    assert len(files) == 33
    for file in files:
        frame = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        found, _ = run(nightfix, file, tmp_path / "out.png", "--tone-only")
        np.testing.assert_array_equal(found, tone_map(frame), err_msg=file.name)
        lo, hi = cut_points(frame)
        assert hi - lo > 300 and found.std() > 30, file.name


def frame_from_square(size: tuple[int, int], focal_px: float, agl_m: float, angles_deg: tuple, side: int, m_per_px: float):
    """Homography from square pixels to frame pixels, and the vehicle's pixel: columns of a camera matrix over the plane."""
    yaw, pitch, roll = np.radians(angles_deg)
    about_down = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    about_right = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    about_forward = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    camera = about_down @ about_right @ about_forward  # forward, right, down -> north, east, down
    optical = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # forward, right, down -> image right, image down, depth
    k = np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1]])
    north, east, _ = camera[:, 2] / camera[2, 2] * agl_m
    middle = (side - 1) / 2
    ground = np.array([[0, -m_per_px, north + m_per_px * middle], [m_per_px, 0, east - m_per_px * middle], [0, 0, agl_m]])
    return k @ optical @ camera.T @ ground, (middle - east / m_per_px, middle + north / m_per_px)


@pytest.mark.parametrize("angles_deg", [(0, 0, 0), (33, 0, 0), (-120, 0, 0), (200, 12, -7), (10, -20, 0), (77, 3, 25)])
def test_rectification_is_opencv_warp_perspective(nightfix: Path, tmp_path: Path, angles_deg: tuple):
    rng = np.random.default_rng(3)
    width, height, hfov_deg, agl_m, side, m_per_px = 640, 512, 50.0, 600.0, 512, 1.0
    frame = cv2.GaussianBlur(rng.integers(0, 256, (height, width)).astype(np.uint8), (0, 0), 3)
    frame = cv2.normalize(frame, None, 0, 255, cv2.NORM_MINMAX)
    cv2.imwrite(str(tmp_path / "frame.png"), frame)
    options = [f"--{name}={value}" for name, value in zip(("yaw-deg", "pitch-deg", "roll-deg"), angles_deg, strict=True)]
    options += [f"--agl-m={agl_m}", f"--hfov-deg={hfov_deg}", f"--size-px={side}", f"--m-per-px={m_per_px}"]
    found, report = run(nightfix, tmp_path / "frame.png", tmp_path / "out.png", *options)
    focal_px = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    homography, vehicle_px = frame_from_square((width, height), focal_px, agl_m, angles_deg, side, m_per_px)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    expected = cv2.warpPerspective(frame, homography, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(np.full_like(frame, 255), homography, (side, side), flags=flags)
    seen = inside == 255
    difference = np.abs(found.astype(int) - expected)[seen]
    assert difference.max() <= 3 and difference.mean() < 0.3, (difference.max(), difference.mean())
    assert seen.mean() - 0.001 <= report["valid_fraction"] <= seen.mean() + 0.02
    assert report["vehicle_px"] == pytest.approx(vehicle_px, abs=1e-6)
    # Where not even a neighbouring pixel is the frame's, there is nothing.
    assert not found[inside == 0].any()


def test_a_frame_that_cannot_be_used_is_an_error_that_names_it(nightfix: Path, tmp_path: Path):
    cv2.imwrite(str(tmp_path / "frame.png"), np.zeros((20, 30), np.uint8))
    (tmp_path / "torn.png").write_bytes((tmp_path / "frame.png").read_bytes()[:40])
    for file, options, text in [
        ("torn.png", ["--gsd-m=1"], "torn.png"),
        ("missing.png", ["--gsd-m=1"], "missing.png"),
        ("frame.png", [], "gsd_m"),
        ("frame.png", ["--gsd-m=0"], "gsd_m"),
        ("frame.png", ["--gsd-m=1", "--width=31", "--height=20"], "width"),
        ("frame.png", ["--agl-m=100", "--hfov-deg=40", "--pitch-deg=60"], "pitch_deg"),
    ]:
        command = [nightfix, "frame", tmp_path / file, "--out", tmp_path / "out.png", *options]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 2 and text in done.stderr and not done.stdout, (file, options, done)


def test_a_contact_sheet_of_real_frames(nightfix: Path, tmp_path: Path, shared: Path):
    command = [nightfix, "frame", "--contact-sheet", shared / "flights" / "guangzhou", "--out", tmp_path / "sheet.png"]
    done = subprocess.run([*command, "--width-m=120", "--tile-px=96"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    # 107 x 86 m of ground on tiles of 120 x 120 m, at any yaw.
    assert report["frames"] == 33 and report["failed"] == [] and 0.55 < report["valid_fraction"] < 0.7, report
    assert cv2.imread(str(tmp_path / "sheet.png"), cv2.IMREAD_UNCHANGED).std() > 30


def test_a_frame_that_is_lost_leaves_its_tile_empty(nightfix: Path, tmp_path: Path):
    cv2.imwrite(str(tmp_path / "there.png"), np.random.default_rng(4).integers(0, 256, (60, 60)).astype(np.uint8))
    (tmp_path / "flight.toml").write_text("")
    (tmp_path / "poses.csv").write_text("file,stamp_ns,gsd_m,yaw_deg\nthere.png,1,1,0\nlost.png,2,1,0\nthere.png,3,,0\n")
    command = [nightfix, "frame", "--contact-sheet", tmp_path, "--out", tmp_path / "sheet.png", "--width-m=60", "--tile-px=60"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3, done
    report = json.loads(done.stdout)
    assert report["frames"] == 1 and [lost["file"] for lost in report["failed"]] == ["lost.png", "there.png"]
    assert "gsd_m" in report["failed"][1]["why"]
