"""The light network: its pieces against independent computations, its pairs, and a training that goes on where it stopped."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import rasterio
import torch

from sthn import correlate, geometry
from sthn.lite import bar, coarse, refine, train
from sthn.lite.pairs import COARSE, FRAME_WIDTH_M, REFINE, Pairs
from sthn.lite.scene import SceneMap, px_to_m, pyramid


def world(size: int = 2200, seed: int = 3) -> np.ndarray:
    """A picture with structure at many scales."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((size, size, 3), np.float32)
    for cells in (6, 20, 70, 250):
        noise = rng.random((cells, cells, 3)).astype(np.float32)
        picture += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture / 4 * 255, 1, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene() -> SceneMap:
    rgb = world()
    return SceneMap("test", 1.0, pyramid(rgb), [], None, rgb.any(axis=2))


@pytest.mark.parametrize("spec", [COARSE, REFINE], ids=["coarse", "refine"])
def test_a_pair_is_the_same_for_the_same_seed_and_number(scene, spec):
    first, again = Pairs([scene], spec, 5).pair(7), Pairs([scene], spec, 5, start=3).pair(7)
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a, b)
    other = Pairs([scene], spec, 6).pair(7)
    assert not torch.equal(first[0], other[0])


def test_the_homography_of_a_pair_takes_the_frame_onto_the_map(scene, monkeypatch):
    monkeypatch.setattr("sthn.lite.thermal.render", lambda rgb, *_: rgb[..., 1].astype(np.float32) / 255)
    monkeypatch.setattr("sthn.lite.thermal.sensor", lambda picture, *_: picture)
    monkeypatch.setattr("sthn.lite.thermal.colour_jitter", lambda rgb, _: rgb.astype(np.float32) / 255)
    for index in range(4):
        image, frame, relation = Pairs([scene], REFINE, 1).pair(index)
        to_px = np.linalg.inv(px_to_m(REFINE.map_px, REFINE.map_width_m)) @ relation.numpy()
        to_px = to_px @ px_to_m(REFINE.frame_px, FRAME_WIDTH_M)
        size = (REFINE.frame_px, REFINE.frame_px)
        warped = cv2.warpPerspective(image[1].numpy(), to_px, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        seen = (frame[1].numpy() > 0) & (warped > 0)
        difference = np.abs(warped - frame[0].numpy())[seen]
        assert np.median(difference) < 0.02, np.median(difference)


def test_solve4_is_a_solver():
    a = torch.randn(5, 4, 4)
    a = a @ a.transpose(1, 2) + 0.1 * torch.eye(4)
    b = torch.randn(5, 4, 2)
    assert torch.allclose(refine.solve4(a, b), torch.linalg.solve(a, b), atol=1e-3)


def test_gather_is_grid_sample():
    features = torch.randn(2, 5, 9, 12)
    points = torch.rand(2, 40, 2) * torch.tensor([14.0, 11.0]) - 1.5
    grid = points / torch.tensor([11.0, 8.0]) * 2 - 1
    wanted = torch.nn.functional.grid_sample(features, grid[:, None], align_corners=True)[:, :, 0]
    assert torch.allclose(refine.gather_bilinear(features, points), wanted, atol=1e-5)


def test_patch_correlation_is_the_mean_product_at_every_offset():
    r, n = 2, 24
    frame, warped = torch.randn(2, 3, n, n), torch.randn(2, 3, n + 2 * r, n + 2 * r)
    found = refine.patch_correlation(frame, warped, r)
    for dy in range(2 * r + 1):
        for dx in range(2 * r + 1):
            product = (frame * warped[:, :, dy : dy + n, dx : dx + n]).sum(1, keepdim=True)
            wanted = torch.nn.functional.avg_pool2d(product, n // refine.PATCHES)[:, 0]
            assert torch.allclose(found[:, dy * (2 * r + 1) + dx], wanted, atol=1e-4)


def test_homography_of_square_is_that_of_four_points():
    corners = torch.tensor([[[3.0, -2.0], [200.0, 9.0], [-5.0, 190.0], [210.0, 205.0]]])
    h = refine.homography_of_square(corners, 192.0)[0].numpy()
    source = np.array([[0, 0], [191, 0], [0, 191], [191, 191]], np.float32)
    wanted = cv2.getPerspectiveTransform(source, corners[0].numpy())
    assert np.allclose(h / h[2, 2], wanted, atol=1e-5)


def test_displacement_of_a_frame_in_the_middle_has_scale_one():
    net = refine.RefineNet()
    displacement = net.displacement(net.first_corners())[0].numpy()
    quad = geometry.edges_of_inclusive(geometry.displaced(net.map_px, displacement), 640.0 / net.map_px)
    assert np.allclose(quad, geometry.edge_corners(512) + 64.0, atol=1e-4)


def test_map_features_belong_to_the_map():
    torch.manual_seed(0)
    net = coarse.CoarseNet((16, 32, 64, 96)).eval()
    image = torch.rand(1, 3, 320, 320)
    with torch.no_grad():
        whole, part = net.encode_map(image), net.encode_map(image[:, :, 64:256, 64:256])
    rim = 44  # cells: what the deepest level sees
    away = (whole[:, :, 32:128, 32:128] - part)[:, :, rim:-rim, rim:-rim].abs().max()
    assert away < 1e-5, away


def test_correlate_all_is_the_definition():
    maps, frames = torch.randn(2, 3, 12, 12), torch.randn(2, 3, 5, 5)
    surfaces = coarse.correlate_all(maps, frames)
    for f in range(2):
        wanted = torch.nn.functional.conv2d(maps, frames[f : f + 1])[:, 0]
        assert torch.allclose(surfaces[f], wanted, atol=1e-4)


def test_correlate_puts_the_middle_of_the_frame_where_it_is():
    maps = np.random.default_rng(0).standard_normal((3, 20, 24)).astype(np.float32)
    frame = maps[:, 5:11, 9:15]
    logits = correlate.correlate(maps, frame[None])[0]
    assert np.unravel_index(logits.argmax(), logits.shape) == (5 + 3, 9 + 3)


def test_a_positive_rotation_is_clockwise_and_scale_goes_outwards():
    gray, seen = np.zeros((192, 192)), np.ones((192, 192))
    gray[90:102, 20:32] = 1.0  # west of the middle
    turned = correlate.hypothesis(gray, seen, 90.0, 1.2)[0]
    y, x = (np.indices(turned.shape) * turned).sum((1, 2)) / turned.sum() - 47.5
    # A clockwise turn takes west to north; 70 px of 192 are 35 of 96, times 1.2.
    assert abs(x) < 0.3 and abs(y + 35 * 1.2) < 0.3, (x, y)
    assert np.array_equal(
        correlate.hypothesis(gray, seen, 0.0, 1.0)[0], gray.reshape(96, 2, 96, 2).mean((1, 3)).astype(np.float32)
    )


def test_training_goes_on_where_it_stopped(tmp_path, monkeypatch):
    path = tmp_path / "maps" / "m.tif"
    path.parent.mkdir()
    rgb = world(1800)
    with rasterio.open(
        path, "w", driver="GTiff", width=1800, height=1800, count=3, dtype="uint8", crs="EPSG:32640",
        transform=rasterio.transform.from_origin(5e5, 2.8e6, 1, 1),
    ) as out:  # fmt: skip
        out.write(np.moveaxis(rgb, -1, 0))
    monkeypatch.setattr(train, "TRAIN_MAPS", ("m.tif",))
    monkeypatch.setattr(train, "NORTH_DAKOTA", ())

    def run(out, *words):
        train.main(
            ["coarse", "--maps", str(path.parent), "--out", str(out), "--steps", "4", "--batch", "2", "--every", "1",
             "--save", "2", "--threads", "1", "--workers", "0", *words]
        )  # fmt: skip
        return torch.load(out / "weights.pt", weights_only=True)

    whole = run(tmp_path / "whole")
    # Stopped after the checkpoint at step 2.
    stopped = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", stop_after(torch.save))
        with pytest.raises(KeyboardInterrupt):
            run(stopped)
    resumed = run(stopped)
    for name, value in whole.items():
        assert torch.equal(value, resumed[name]), name
    assert len((stopped / "curve.csv").read_text().splitlines()) == 5
    with pytest.raises(SystemExit, match="recipe: expected .*'steps': 5.* found .*'steps': 4"):
        run(stopped, "--steps", "5")
    with pytest.raises(SystemExit, match="absent: expected at least one GeoTIFF"):
        run(tmp_path / "other", "--worlds", str(tmp_path / "absent"))


def stop_after(save):
    """`torch.save`, then an interrupt after the first checkpoint is in place."""
    calls = []

    def wrapped(state, path):
        if calls:
            raise KeyboardInterrupt
        calls.append(path)
        save(state, path)

    return wrapped


def test_the_bars_page_says_its_own_radius_and_whose_error_mace_has():
    page = bar.report(["--radius-m", "64"], 64.0, "| a |")
    assert "D_C = 64 m" in page and "512 m" not in page.split("\n", 3)[3] and page.endswith("| a |\n")
    assert "error of height counts against\nthe method" in page
    # As said: a frame of 5 % more ground moves a corner by 18 m.
    fix = {"status": "fix", "window": {"lat_deg": 25.0, "lon_deg": 55.0, "width_m": 1536}}
    pose = {"truth_lat_deg": "25", "truth_lon_deg": "55", "truth_yaw_deg": "3", "yaw_deg": "3"}
    quad = correlate.similarity_quad(np.array([767.5, 767.5]), 0.0, 1.05, 512)
    fix["homography"] = geometry.homography_of_edges(512, quad)
    assert bar.corner_error_m(fix, pose) == pytest.approx(0.05 * 256 * 2**0.5, abs=1e-6)
