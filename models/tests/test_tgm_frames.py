"""Generated frames in the light training's pairs, and the comparison's measure."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
import torch

from sthn.lite.pairs import COARSE, Pairs
from sthn.lite.scene import SceneMap, pyramid
from sthn.tgm import compare
from sthn.tgm.checkpoint import TgmError
from sthn.tgm.frames import NightPairs, PairsWithGenerated, load_generated
from sthn.tgm.rendered import Night


@pytest.fixture(scope="module")
def scene() -> SceneMap:
    rng = np.random.default_rng(2)
    rgb = np.kron(rng.integers(20, 250, (30, 30, 3)), np.ones((60, 60, 1))).astype(np.uint8)
    return SceneMap("fields", 1.0, pyramid(rgb), [], None, rgb.any(axis=2))


def save(path: Path, gray: np.ndarray) -> None:
    profile = {"crs": "EPSG:32640", "transform": rasterio.transform.from_origin(3e5, 28e5, 1.0, 1.0)}
    height, width = gray.shape
    with rasterio.open(path, "w", driver="GTiff", height=height, width=width, count=1, dtype="uint8", **profile) as target:
        target.write(gray, 1)


def test_frames_come_from_the_painted_map(scene: SceneMap, tmp_path: Path) -> None:
    # A painted map with the red channel: a frame correlates with what red shows under it, up to the sensor's faults.
    red = scene.levels[0][..., 0].copy()
    save(tmp_path / "fields.tif", red)
    generated = load_generated(tmp_path, [scene])
    seen = []

    class Watched(PairsWithGenerated):
        def gray(self, scene, seen_rgb, classes, to_frame, rng):
            gray = super().gray(scene, seen_rgb, classes, to_frame, rng)
            seen.append(np.corrcoef(gray.ravel(), seen_rgb[..., 0].ravel())[0, 1])
            return gray

    pairs = Watched([scene], COARSE, 5, 0, generated, 1.0)
    for index in range(12):
        pairs.pair(index)
    assert np.median(seen) > 0.6
    seen.clear()
    other = Watched([scene], COARSE, 5, 0, generated, 0.0)
    for index in range(12):
        other.pair(index)
    assert np.median(np.abs(seen)) < 0.6


def test_without_a_painted_map_the_stream_is_the_same(scene: SceneMap) -> None:
    plain, mixed = Pairs([scene], COARSE, 5), PairsWithGenerated([scene], COARSE, 5, 0, {"another": []}, 0.5)
    assert all(torch.equal(a, b) for a, b in zip(plain.pair(3), mixed.pair(3), strict=True))


def test_what_is_wrong_is_named(scene: SceneMap, tmp_path: Path) -> None:
    with pytest.raises(TgmError, match="expected at least one of fields.tif, found none"):
        load_generated(tmp_path, [scene])
    save(tmp_path / "fields.tif", np.ones((10, 20), np.uint8))
    with pytest.raises(TgmError, match="expected 1800 x 1800 px as its map, found 20 x 10"):
        load_generated(tmp_path, [scene])
    with pytest.raises(TgmError, match="expected 0 to 1, found 1.5"):
        PairsWithGenerated([scene], COARSE, 5, 0, {}, 1.5)


def test_night_frames_have_one_rule(scene: SceneMap) -> None:
    pairs = NightPairs([scene], COARSE, 3, Night([scene], 1))
    again = NightPairs([scene], COARSE, 3, Night([scene], 1))
    assert torch.equal(pairs.pair(2)[1], again.pair(2)[1])


def test_error_of_a_perfect_net_is_below_a_cell(scene: SceneMap) -> None:
    """The peak at the truth's cell gives an error of the sub-cell's size only."""

    class Oracle(torch.nn.Module):
        def encode_map(self, image):
            return image

        def encode_frame(self, frame):
            return frame

    pairs = NightPairs([scene], COARSE, 3, Night([scene], 1))
    truths = iter([pairs.pair(i)[2] for i in range(5)])

    def at_the_truth(_map, frame):
        relation = next(truths).numpy()
        middle = relation[:2, 2] / relation[2, 2] / (COARSE.map_width_m / COARSE.map_px)
        cell = (middle + (COARSE.map_px - 1) / 2 - 0.5) / 2 - (48 - 1) / 2
        surface = torch.zeros(1, 1, 81, 81)
        y, x = torch.meshgrid(torch.arange(81.0), torch.arange(81.0), indexing="ij")
        surface[0, 0] = -((x - cell[0]) ** 2 + (y - cell[1]) ** 2)
        return surface

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare.coarse, "correlate_all", at_the_truth)
        patch.setattr(Oracle, "encode_frame", lambda self, frame: torch.zeros(1, 1, 48, 48))
        errors = compare.errors_m(Oracle(), pairs, 5)
    assert errors.max() < 0.5  # of 10.7 m cells
