"""The traps of the published network, each pinned; torch and OpenCV as oracles."""

import cv2
import numpy as np
import pytest
import torch
from conftest import SMALL
from torch.nn import functional as F

from sthn.network import (
    Lookup,
    Sthn,
    bounding_box,
    combine,
    crop,
    half_pixel_weights,
    published_weights,
    resize,
    resize_satellite,
)
from sthn.network.correlation import correlation_pyramid, look_up, lookup_coordinates
from sthn.network.homography import feature_homography, identity_grid, inverse, square_to_quad, transform_grid
from sthn.network.resize import resize_thermal


def corners(quad: list[tuple[float, float]]) -> torch.Tensor:
    """TL, TR, BL, BR -> `[1, 2, 2, 2]`."""
    return torch.tensor(quad, dtype=torch.float64).T.reshape(1, 2, 2, 2)


QUAD = [(3.0, -2.0), (60.0, 5.0), (-4.0, 58.0), (70.0, 66.0)]


def test_the_closed_form_homography_is_opencvs() -> None:
    square = np.float32([(0, 0), (63, 0), (0, 63), (63, 63)])
    expected = cv2.getPerspectiveTransform(square, np.float32(QUAD))
    found = square_to_quad(corners(QUAD), 63.0)[0].numpy()
    assert np.abs(found - expected).max() < 1e-6
    back = inverse(torch.from_numpy(found)[None])[0].numpy()
    assert np.abs(back / back[2, 2] - np.linalg.inv(expected) / np.linalg.inv(expected)[2, 2]).max() < 1e-6


def test_displacements_are_input_pixels_xy_first_then_row_then_column() -> None:
    displacement = torch.zeros(1, 2, 2, 2, dtype=torch.float64)
    displacement[0, 0, 0, 1], displacement[0, 1, 1, 0] = 8.0, -12.0  # x of the top right, y of the bottom left
    moved = transform_grid(feature_homography(displacement, 64), identity_grid(64, displacement))[0]
    assert torch.allclose(moved[:, 0, 63], torch.tensor([65.0, 0.0], dtype=torch.float64))
    assert torch.allclose(moved[:, 63, 0], torch.tensor([0.0, 60.0], dtype=torch.float64))
    assert torch.allclose(moved[:, 63, 63], torch.tensor([63.0, 63.0], dtype=torch.float64))


def sampled(pyramid: list[torch.Tensor], coordinates: torch.Tensor) -> torch.Tensor:
    """The look-up by grid_sample, written from the definition, channel by channel."""
    height, width = coordinates.shape[-2:]
    out = []
    for i, level in enumerate(pyramid):
        cells = level.flatten(0, 1)[:, None]
        for a in range(-4, 5):
            for b in range(-4, 5):
                at = coordinates.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2) / 2**i + torch.tensor([a, b])
                grid = 2 * at / torch.tensor([cells.shape[-1] - 1, cells.shape[-2] - 1]) - 1
                out.append(F.grid_sample(cells, grid, align_corners=True).reshape(-1, height, width))
    return torch.stack(out, 1)


def test_the_look_up_is_grid_sample_with_the_slow_index_along_x() -> None:
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(2, 1, 16, 16, 16, generator=generator, dtype=torch.float64).expand(2, 2, 16, 16, 16)
    pyramid = correlation_pyramid(features[0], features[1], 3, Lookup.PUBLISHED)
    coordinates = torch.rand(2, 2, 16, 16, generator=generator, dtype=torch.float64) * 40 - 12
    coordinates[0, :, 0, :4] = torch.tensor([[1e9, -1e9, 15.0, -4.0], [3.0, 3.0, 15.0, 20.0]], dtype=torch.float64)
    assert (look_up(pyramid, coordinates) - sampled(pyramid, coordinates)).abs().max() < 1e-9
    # One bright cell 3 to the right of and 1 above the centre: channel 9 (3 + 4) + (-1 + 4).
    level = torch.zeros(1, 1, 16, 16)
    level[0, 0, 7, 11] = 1
    assert look_up([level], torch.full((1, 2, 1, 1), 8.0)).flatten().nonzero().item() == 9 * 7 + 3


def test_numbers_that_are_not_finite_reach_the_caller(small: Sthn) -> None:
    level = torch.ones(1, 1, 16, 16)
    for value in (float("nan"), float("inf")):
        found = look_up([level], torch.full((1, 2, 1, 1), value))
        assert found.shape == (1, 81, 1, 1)
    assert look_up([level], torch.full((1, 2, 1, 1), float("nan"))).isnan().all()


def test_relu_comes_before_pooling() -> None:
    generator = torch.Generator().manual_seed(2)
    first, second = torch.randn(2, 1, 8, 8, 8, generator=generator)
    pyramid = correlation_pyramid(first, second, 2, Lookup.PUBLISHED)
    raw = (first.flatten(2).transpose(1, 2) @ second.flatten(2)).unflatten(2, (8, 8))
    assert torch.allclose(pyramid[1], F.avg_pool2d(raw.relu(), 2))
    pooled_features = (first.flatten(2).transpose(1, 2) @ F.avg_pool2d(second, 2).flatten(2)).relu().unflatten(2, (4, 4))
    assert (pyramid[1] - pooled_features).abs().max() > 0.5


def test_the_correlation_is_not_scaled() -> None:
    first, second = torch.full((2, 1, 16, 8, 8), 2.0)
    assert correlation_pyramid(first, second, 1, Lookup.PUBLISHED)[0].max() == 64


@pytest.mark.parametrize(
    ("lookup", "least", "most"), [("published", 0.0, 0.2), ("map_indexed", 0.9, 1.0), ("frame_indexed", 0.9, 1.0)]
)
def test_only_the_consistent_directions_look_where_the_match_is(lookup: str, least: float, most: float) -> None:
    """Features that are the same place's in both images: under the true homography, how often is the window's centre
    its peak? The published direction looks in the wrong place, and released weights rely on it."""
    direction = Lookup(lookup)
    generator = torch.Generator().manual_seed(3)
    side = 32
    map_features = F.normalize(torch.randn(1, 64, side, side, generator=generator), dim=1)
    displacement = torch.tensor([16.0, -8.0]).reshape(1, 2, 1, 1).expand(1, 2, 2, 2)  # a shift of (4, -2) cells
    matrix = feature_homography(displacement, side)
    grid = identity_grid(side, map_features)
    at = transform_grid(matrix, grid).permute(0, 2, 3, 1) / (side - 1) * 2 - 1
    frame_features = F.grid_sample(map_features, at, align_corners=True)
    pyramid = correlation_pyramid(map_features, frame_features, 1, direction)
    coordinates = lookup_coordinates(matrix, grid, direction)
    window = look_up(pyramid, coordinates)
    inside = ((coordinates >= 0) & (coordinates <= side - 1)).all(1, keepdim=True)
    share = (window.argmax(1, keepdim=True) == 40)[inside].float().mean().item()
    assert least <= share <= most


def test_directions_differ_in_the_network_too(small: Sthn) -> None:
    generator = torch.Generator().manual_seed(4)
    images = torch.rand(2, 1, 3, 64, 64, generator=generator)
    with torch.inference_mode():
        found = {}
        for direction in Lookup:
            other = Sthn(SMALL, direction)
            other.load_state_dict(small.state_dict())
            found[direction] = other.netG(images[0], images[1])
    published = found[Lookup.PUBLISHED]
    assert torch.equal(found[Lookup.MAP_INDEXED][0], published[0]), "at the identity H and its inverse agree"
    assert (found[Lookup.MAP_INDEXED][1] - published[1]).abs().max() > 1e-3
    assert (found[Lookup.FRAME_INDEXED][0] - published[0]).abs().max() > 1e-3


def test_one_map_serves_many_frames(small: Sthn) -> None:
    generator = torch.Generator().manual_seed(5)
    map_image, frames = torch.rand(1, 3, 64, 64, generator=generator), torch.rand(3, 3, 64, 64, generator=generator)
    net = small.netG
    with torch.inference_mode():
        together = net.match(net.encode(map_image), net.encode(frames))
        alone = torch.cat([net(map_image, frame[None]) for frame in frames], 1)
    assert together.shape == (3, 3, 2, 2, 2)
    assert (together - alone).abs().max() < 1e-3


@pytest.mark.parametrize("size", [512, 1024, 1536])
def test_the_published_resize_as_a_formula_is_torchs(size: int) -> None:
    image = np.random.default_rng(size).random((3, size, size))
    torchs = resize_satellite(torch.from_numpy(image)[None], 256)[0].numpy()
    assert np.abs(resize(image, published_weights(size, 256)) - torchs).max() < 1e-5
    torchs = resize_thermal(torch.from_numpy(image)[None], 256)[0].numpy()
    assert np.abs(resize(image, half_pixel_weights(size, 256)) - torchs).max() < 1e-5


def test_an_ordinary_resize_would_move_positions_by_metres() -> None:
    ramp = np.arange(1536.0) + 0.5
    shift = (published_weights(1536, 256) - half_pixel_weights(1536, 256)) @ ramp
    assert abs(shift[0]) < 0.05
    assert 2.4 < shift[128] < 2.6
    assert 4.0 < shift[250] < 5.0


def test_the_crop_is_bilinear_between_corners_with_zeros_outside() -> None:
    window = torch.rand(2, 3, 128, 128, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    displacement = torch.tensor([[-30.0, 11.3], [2.5, -7.0]], dtype=torch.float64)[:, :, None, None].expand(2, 2, 2, 2)
    box = bounding_box(displacement, SMALL)
    steps = torch.arange(64, dtype=torch.float64) / 63
    x, y = (edge[:, None] + steps * (box.width[:, None] - 1) for edge in (box.left, box.top))
    grid = torch.stack([x[:, None, :].expand(2, 64, 64), y[:, :, None].expand(2, 64, 64)], -1) / 127 * 2 - 1
    expected = F.grid_sample(window, grid, align_corners=True)
    assert (crop(window, box, 64) - expected).abs().max() < 1e-9
    assert (expected[0, :, :, :10] == 0).all(), "the first box hangs out of the window"


def test_the_box_covers_inclusive_corners_and_padding() -> None:
    """No displacement: the whole window, 4 px more on each side. Corners count as pixels: the right one adds its own."""
    box = bounding_box(torch.zeros(1, 2, 2, 2), SMALL)
    assert (box.left.item(), box.top.item(), box.width.item()) == (-4.0, -4.0, 136.0)
    narrow = torch.zeros(1, 2, 2, 2)
    narrow[0, 0, :, 1] = -32.0  # 32 px wide, 64 high: made square about its centre
    box = bounding_box(narrow, SMALL)
    assert (box.left.item(), box.top.item(), box.width.item()) == (32.0 - 64.0 - 4.0, -4.0, 136.0)


def test_combining_keeps_a_perfect_fit() -> None:
    """Fine corners on the box's corners: the final corners, as edges of window pixels, are the box's edges."""
    displacement = torch.tensor([3.0, -5.0]).reshape(1, 2, 1, 1).expand(1, 2, 2, 2)
    box = bounding_box(displacement, SMALL)
    final = combine(torch.zeros(1, 2, 2, 2), box, SMALL)
    left, right = final[0, 0, 0, 0] * SMALL.alpha, (63 + final[0, 0, 0, 1] + 1) * SMALL.alpha
    assert abs(left - box.left).item() < 1e-4
    assert abs(right - (box.left + box.width)).item() < 1e-4


def test_gradients_of_the_fine_stage_stop_at_the_box(small: Sthn) -> None:
    window, thermal = torch.rand(2, 1, 3, 128, 128, generator=torch.Generator().manual_seed(7))
    match = small(window, thermal[..., :64, :64].clone())
    match.final.sum().backward()
    assert all(p.grad is None for p in small.netG.parameters())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in small.netG_fine.parameters())
    small.zero_grad(set_to_none=True)
