"""The numpy pipeline's parts against torch and pyproj."""

import numpy as np
import pytest
import torch
from conftest import SMALL
from pyproj import Geod
from torch.nn import functional as F

from sthn import geometry, pipeline, procedural
from sthn.network import bounding_box, combine, crop
from sthn.parity import to_tensor

WINDOW = np.random.default_rng(0).integers(0, 256, (128, 128, 3), dtype=np.uint8)


def spec(content: str, resize: str, size_px: int = 64) -> dict[str, object]:
    return {"size_px": size_px, "width_m": 128.0, "content": content, "resize": resize}


@pytest.mark.parametrize(("rule", "corners"), [("half_pixel_antialias", False), ("align_corners_antialias", True)])
def test_inputs_are_torchs(rule: str, corners: bool) -> None:
    torchs = F.interpolate(to_tensor(WINDOW), size=(64, 64), mode="bilinear", align_corners=corners, antialias=True).numpy()
    assert np.abs(pipeline.map_input(WINDOW, spec("rgb", rule)) - torchs).max() < 1e-5
    thrice = pipeline.frame_input(WINDOW[:, :, 1], None, spec("gray_thrice", rule))
    assert thrice.shape == (1, 3, 64, 64) and np.abs(thrice - torchs[:, 1:2]).max() < 1e-5
    assert np.array_equal(pipeline.frame_input(WINDOW[:, :, 1], None, spec("gray", rule)), thrice[:, :1])
    wide = np.pad(WINDOW, ((5, 5), (5, 5), (0, 0)), constant_values=99)
    assert np.array_equal(pipeline.map_input(wide, spec("rgb", rule), 5), pipeline.map_input(WINDOW, spec("rgb", rule)))


def test_what_was_not_seen_does_not_darken_its_neighbours() -> None:
    seen = np.arange(128)[None].repeat(128, 0) < 63
    frame = np.where(seen, 200, 0).astype(np.uint8)
    gray, mask = pipeline.frame_input(frame, seen, spec("gray_mask", "half_pixel_antialias"))[0]
    assert set(np.unique(mask)) == {0.0, 1.0} and mask[0].sum() == 32
    assert np.allclose(gray[mask == 1], 200 / 255) and (gray[mask == 0] == 0).all()
    full = pipeline.frame_input(frame, None, spec("gray_mask", "half_pixel_antialias"))[0]
    assert (full[1] == 1).all()


@pytest.mark.parametrize("shift", [0.0, -37.3, 61.0])
def test_box_crop_and_combination_are_the_networks(shift: float) -> None:
    generator = np.random.default_rng(3)
    displacement = generator.normal(0, 5, (2, 2, 2)) + shift
    tensor = torch.from_numpy(displacement)[None]
    box = bounding_box(tensor, SMALL)
    coarse = geometry.edges_of_inclusive(geometry.displaced(64, displacement), SMALL.alpha)
    start, width = pipeline.bounding_box(coarse, SMALL.fine_padding)
    assert np.allclose([*start, width], [box.left.item(), box.top.item(), box.width.item()], atol=1e-9)
    found = pipeline.crop_bounding_box(WINDOW, start, width, 64)
    assert np.abs(found - crop(to_tensor(WINDOW), box, 64).numpy()).max() < 1e-5
    fine = generator.normal(0, 3, (2, 2, 2))
    quad = pipeline.combine(geometry.displaced(64, fine), start, width, 64)
    manifest = {"coarse": {"kind": "matcher", "map": spec("rgb", "align_corners_antialias")}}
    final = pipeline.final_displacement(manifest, quad)
    assert np.abs(final - combine(torch.from_numpy(fine)[None], box, SMALL)[0].numpy()).max() < 1e-9


def test_pixels_become_positions_along_the_geodesic() -> None:
    centre = (25.2, 55.27)
    assert pipeline.window_to_lat_lon(np.array([767.5, 767.5]), centre, 1536) == pytest.approx(centre, abs=1e-12)
    lat, lon = pipeline.window_to_lat_lon(np.array([767.5 + 300, 767.5 - 400]), centre, 1536)
    azimuth, _, distance = Geod(ellps="WGS84").inv(centre[1], centre[0], lon, lat)
    assert distance == pytest.approx(500, abs=1e-6)
    assert azimuth == pytest.approx(np.degrees(np.arctan2(300, 400)), abs=1e-9)
    assert lat > centre[0] and lon > centre[1], "x is east, y is south"


def test_the_frame_lies_where_it_was_cut() -> None:
    """Truth of the procedural pair: rows 400.., columns 700.. of the window. A perfect quad gives it back."""
    frame = procedural.frame_of(procedural.image(1536))
    quad = geometry.edge_corners(512) + [700, 400]
    homography = geometry.homography_of_edges(512, quad)
    x, y = geometry.apply(homography, [10.0, 20.0]).round().astype(int)
    assert (x, y) == (710, 420)
    assert frame[20, 10] == np.floor(255 - procedural.image(1536)[y, x].mean())
