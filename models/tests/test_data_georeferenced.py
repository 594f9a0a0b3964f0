"""Pairs from maps and from recorded flights: the truth against pictures made another way."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from conftest import ROOT
from pyproj import Geod, Transformer

from sthn import geometry
from sthn.data import DataError, open_source
from sthn.data.flight import MapWindows, RecordedFlight
from sthn.data.georeferenced import FlightPairs
from sthn.train.stream import Stream, loader

EARTH = Geod(ellps="WGS84")
SIDE = 1800
WEST, NORTH = 300_000.0, 3_900_000.0
"""Far from the central meridian: grid north is 1.3 degrees west of true north there."""


def picture() -> np.ndarray:
    rng = np.random.default_rng(4)
    out = np.zeros((SIDE, SIDE), np.float32)
    for cells in (8, 30, 120):
        out += cv2.resize(rng.random((cells, cells)).astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    return np.clip(out * 70 + 20, 1, 255)


@pytest.fixture(scope="module")
def satellite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "m.tif"
    profile = {"driver": "GTiff", "width": SIDE, "height": SIDE, "count": 3, "dtype": "uint8", "nodata": 0}
    with rasterio.open(
        path, "w", crs="EPSG:32612", transform=rasterio.transform.from_origin(WEST, NORTH, 1, 1), **profile
    ) as file:
        file.write(np.repeat(picture()[None].astype(np.uint8), 3, 0))
    return path


def ground_of(
    vehicle: tuple[float, float], yaw: float, pitch: float, roll: float, agl: float, hfov: float, size: tuple[int, int]
):
    """Latitude and longitude of every pixel of a pinhole frame, by rays and geodesics: another way than the code's."""
    width, height = size
    focal = width / 2 / np.tan(np.radians(hfov) / 2)
    u, v = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    body = np.stack([-v, u, np.full_like(u, focal)], -1)
    y, p, r = np.radians([yaw, pitch, roll])
    rz = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    ry = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    rx = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    ned = body @ (rz @ ry @ rx).T
    north, east = (ned[..., i] / ned[..., 2] * agl for i in (0, 1))
    shape = north.shape
    start = [np.full(shape, vehicle[1]), np.full(shape, vehicle[0])]
    lon, lat, _ = EARTH.fwd(*start, np.degrees(np.arctan2(east, north)), np.hypot(east, north))
    return np.asarray(lat), np.asarray(lon)


@pytest.fixture(scope="module")
def flight(satellite: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames: one level with a yaw that is known wrongly, one that tilts; the camera is mounted askew."""
    out = tmp_path_factory.mktemp("flight")
    to_wgs84 = Transformer.from_crs(32612, 4326, always_xy=True)
    to_map = Transformer.from_crs(4326, 32612, always_xy=True)
    lines = [
        "file,stamp_ns,agl_m,yaw_deg,pitch_deg,roll_deg,prior_lat_deg,prior_lon_deg,truth_lat_deg,truth_lon_deg,truth_yaw_deg"
    ]
    for i, (yaw, said, pitch, roll) in enumerate([(35.0, 31.0, None, None), (200.0, 200.0, 6.0, -4.0)]):
        lon, lat = to_wgs84.transform(WEST + 880 + 40 * i, NORTH - 930)
        mounted = 90.0  # the camera's yaw is the vehicle's plus this
        camera = (yaw + mounted, *(0.0, 0.0)) if pitch is None else _camera_of(yaw, pitch, roll, mounted)
        lat_px, lon_px = ground_of((lat, lon), *camera, 600.0, 69.2, (400, 320))
        x, y = to_map.transform(lon_px, lat_px)
        at = [(np.asarray(c) - 0.5).astype(np.float32) for c in (x - WEST, NORTH - y)]
        cv2.imwrite(str(out / f"{i}.png"), np.round(cv2.remap(picture(), *at, cv2.INTER_LINEAR)).astype(np.uint8))
        tilt = ["", ""] if pitch is None else [pitch, roll]
        truth_yaw = camera[0]
        lines.append(",".join(map(str, [f"{i}.png", i, 600, said, *tilt, lat + 1e-4, lon, lat, lon, truth_yaw])))
    (out / "poses.csv").write_text("\n".join(lines) + "\n")
    (out / "flight.toml").write_text("schema = 1\n[camera]\nhfov_deg = 69.2\nmount_yaw_deg = 90\n")
    return out


def _camera_of(yaw: float, pitch: float, roll: float, mounted: float) -> tuple[float, float, float]:
    from scipy.spatial.transform import Rotation

    both = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True) * Rotation.from_euler("Z", mounted, degrees=True)
    return tuple(both.as_euler("ZYX", degrees=True))


def difference(pair, shift: tuple[float, float] = (0.0, 0.0)) -> float:
    """Median gray difference of the frame and the window under it, moved by `shift` window px."""
    moved = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]]) @ pair.homography
    size = pair.thermal.shape[::-1]
    under = cv2.warpPerspective(pair.satellite[..., 0], moved, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    seen = (pair.thermal > 0) & (under > 0)
    assert seen.mean() > 0.6
    return float(np.abs(under.astype(float) - pair.thermal)[seen].mean())


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("own_priors", [True, False])
def test_frames_of_a_flight_lie_where_the_truth_says(flight: Path, satellite: Path, index: int, own_priors: bool) -> None:
    pairs = FlightPairs(RecordedFlight.open(flight), satellite, 1024, 150, seed=2, own_priors=own_priors)
    pair = pairs[index]
    at_truth = difference(pair)
    for shift in ((2, 0), (-2, 0), (0, 2), (0, -2)):
        assert difference(pair, shift) > 1.5 * at_truth, (at_truth, shift)
    off = np.hypot(*(pair.centre() - 511.5))
    assert 0 < off < 150 + 80, "the tilted frame's middle lies ahead of the vehicle"
    if own_priors and index == 0:
        assert off == pytest.approx(11.1, abs=0.1)  # 1e-4 degrees of latitude


def test_a_flight_opens_from_a_table_and_travels_to_workers(flight: Path, satellite: Path) -> None:
    spec = {"kind": "flight", "folder": str(flight), "map": str(satellite), "window_m": 1024, "search_radius_m": 100}
    source = open_source(spec | {"seed": 3})
    other = pickle.loads(pickle.dumps(source))
    assert len(source) == 2 and np.array_equal(source[1].satellite, other[1].satellite)
    assert not np.array_equal(source[0].homography, source.reseeded((3, 1))[0].homography)


def test_a_flights_noise_turns_what_was_seen_about_the_frame(flight: Path, satellite: Path) -> None:
    """Rotated frames have no wedges that tell the answer; what the sensor did not see is said."""
    spec = {"kind": "flight", "folder": str(flight), "map": str(satellite), "window_m": 1024, "search_radius_m": 100}
    plain, wide = open_source(spec), open_source(spec | {"surround": True})
    for index in range(2):
        one, other = plain[index], wide[index]
        assert other.surround.shape == other.seen.shape == (768, 768)
        assert np.array_equal(one.homography, other.homography)
        assert np.abs(one.thermal.astype(int) - other.thermal).max() <= 2
        seen = np.ones((512, 512), bool) if one.frame_seen is None else one.frame_seen
        assert (seen == other.frame_seen).mean() > 0.999 and not one.thermal[~seen].any() and one.thermal[seen].all()
    noisy = open_source(spec | {"noise": {"rotation_deg": 30, "kind": "rotation"}})
    assert noisy.source.surround and difference(noisy[1]) < 3 < difference(noisy[1], (6, 0))


def test_loader_workers_read_the_map_as_this_process_does(flight: Path, satellite: Path) -> None:
    """A handle that was open before the fork is one file position for all: reads fail, or are of another place."""
    spec = {"kind": "flight", "folder": str(flight), "map": str(satellite), "window_m": 512, "search_radius_m": 300}
    source = open_source(spec)
    before = source[0].satellite
    stream = Stream(source, None, 3, 64)
    loaded = [window[0].numpy() for window, *_ in loader(stream, [[n] for n in range(16)], workers=2)]
    assert all(np.array_equal(window, stream.pair(n).satellite) for n, window in enumerate(loaded))
    assert np.array_equal(source[0].satellite, before)


def test_windows_are_metres_of_true_north(satellite: Path) -> None:
    """A map pixel found through the geodesic from the window's middle."""
    windows = MapWindows(satellite)
    centre = windows.moved((35.22, -113.1950), 0, 0)
    x, y = Transformer.from_crs(4326, 32612, always_xy=True).transform(centre[1], centre[0])
    assert WEST < x < WEST + SIDE and NORTH - SIDE < y < NORTH
    window = windows.window(centre, 401, 1.0)
    whole = picture()
    for px, py in [(30, 40), (370, 60), (200, 200), (80, 350)]:
        lat, lon = windows.moved(centre, px - 200, 200 - py)
        x, y = Transformer.from_crs(4326, 32612, always_xy=True).transform(lon, lat)
        wanted = cv2.remap(whole, np.float32([[x - WEST - 0.5]]), np.float32([[NORTH - y - 0.5]]), cv2.INTER_LINEAR)[0, 0]
        assert abs(float(window[py, px, 0]) - wanted) < 2
    assert not windows.window((0.0, 0.0), 64, 1.0).any()


@pytest.mark.parametrize("m_per_px", [1.0, 4.0])
def test_synthesised_frames_lie_where_the_truth_says(satellite: Path, monkeypatch: pytest.MonkeyPatch, m_per_px: float) -> None:
    monkeypatch.setattr("sthn.lite.thermal.render", lambda rgb, *_: rgb[..., 0].astype(np.float32) / 255)
    monkeypatch.setattr("sthn.lite.thermal.sensor", lambda picture, *_: picture)
    monkeypatch.setattr("sthn.lite.thermal.colour_jitter", lambda rgb, _: rgb.astype(np.float32) / 255)
    side = int(512 / m_per_px)
    spec = {"kind": "maps", "maps": [str(satellite)], "count": 4, "window_m": 2 * side, "search_radius_m": 256.0}
    source = open_source(spec | {"m_per_px": m_per_px, "frame_px": side, "augment": True, "surround": True})
    for index in range(2):
        pair = source[index]
        assert pair.thermal.shape == (side, side) and pair.surround.shape == (side * 3 // 2, side * 3 // 2)
        assert np.array_equal(pair.surround[side // 4 : -side // 4, side // 4 : -side // 4], pair.thermal)
        assert np.hypot(*(pair.centre() - (2 * side - 1) / 2)) * m_per_px <= 256
        assert difference(pair) < 3 < difference(pair, (12 / m_per_px, 0))


def test_map_pairs_are_seeded_and_fill_the_disc(satellite: Path) -> None:
    spec = {"kind": "maps", "maps": [str(satellite)], "count": 60, "window_m": 128, "search_radius_m": 200}
    small = {"m_per_px": 8.0, "frame_px": 64}
    source, again = (open_source(spec | small) for _ in range(2))
    assert np.array_equal(source[3].thermal, again[3].thermal) and np.array_equal(source[3].satellite, again[3].satellite)
    shifts = np.array([source[i].centre() - 63.5 for i in range(60)]) * 8
    radius = np.hypot(*shifts.T)
    # Uniform over a disc: half of them lie beyond R / sqrt 2.
    assert radius.max() <= 200 and 0.25 < (radius > 200 / np.sqrt(2)).mean() < 0.75
    assert abs(shifts.mean(0)).max() < 60


def test_a_style_is_one_curve_for_all_frames(satellite: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sthn.lite.thermal.sensor", lambda values, *_: (values - values.min()) / np.ptp(values))
    spec = {"kind": "maps", "maps": [str(satellite)], "count": 9, "window_m": 64, "search_radius_m": 9, "m_per_px": 8.0}

    def along(style: int | None, index: int) -> float:
        """Correlation of frame and map where they lie on one another."""
        pair = open_source(spec | {"frame_px": 64} | ({} if style is None else {"style": style}))[index]
        size = (64, 64)
        under = cv2.warpPerspective(pair.satellite[..., 0], pair.homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return float(np.corrcoef(under[4:-4, 4:-4].ravel(), pair.thermal[4:-4, 4:-4].ravel())[0, 1])

    one = [along(2, i) for i in range(6)]
    assert np.std(one) < 0.15 < np.std([along(None, i) for i in range(6)])


def test_the_committed_flight_opens() -> None:
    flight = ROOT / "tests/flights/procedural"
    spec = {"kind": "flight", "folder": str(flight), "map": str(flight / "world.tif"), "window_m": 1024, "search_radius_m": 300}
    source = open_source(spec | {"count": 2})
    pair = source[1]
    assert pair.thermal.shape == (512, 512) and (pair.satellite.max(2) > 0).mean() > 0.5 and len(source) == 2
    # The truth's turn is the difference of the true and the stated yaw.
    top = np.diff(geometry.apply(pair.homography, [[0, 255], [511, 255]]), axis=0)[0]
    rows = source.source.rows
    row = next(r for r in rows if r.file == pair.name)
    assert np.degrees(np.arctan2(top[1], top[0])) == pytest.approx(row.truth_yaw_deg - row.numbers["yaw_deg"], abs=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "h5"}, r"kind: expected boson \| maps \| flight, found 'h5'"),
        ({"windows_m": 512}, "windows_m: expected one of .*, found an unknown key"),
        ({"window_m": "512"}, "window_m: expected int, found '512'"),
        ({"maps": ["nowhere.tif"]}, "maps: expected files that are there, found nowhere.tif"),
        ({"noise": {"rotation_deg": 400}}, "noise: rotation_deg: expected a bound"),
        ({"noise": {"scale": 0.1, "kind": "rotation"}}, "noise: kind: expected none or a kind"),
        ({"noise": {"turn": 4}}, "noise: turn: expected one of"),
        ({"count": 0}, "count: expected at least 1, found 0"),
    ],
)
def test_a_table_that_says_something_else_is_an_error(satellite: Path, change: dict, said: str) -> None:
    spec = {"kind": "maps", "maps": [str(satellite)], "count": 4, "window_m": 512, "search_radius_m": 64}
    with pytest.raises(DataError, match=said):
        open_source(spec | change)
