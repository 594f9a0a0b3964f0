"""Geometric noise: its truth against the picture, to a fraction of a pixel, and its bounds."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import pytest

from sthn import geometry
from sthn.data import Noise, Noisy, Pair
from sthn.data.noise import draw, warp

NOISE = Noise(rotation_deg=30, scale=0.3, perspective_px=32)


@functools.cache
def picture(side: int, seed: int = 0) -> np.ndarray:
    """Smooth enough to be interpolated, with structure to register."""
    noise = np.random.default_rng(seed).random((side // 12, side // 12)).astype(np.float32)
    return np.clip(cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC) * 160 + 48, 1, 255).astype(np.uint8)


class One:
    """A source of one picture: the frame is the middle of a surround that is the middle of the window."""

    name, window_m, search_radius_m = "one", 1024, 0.0

    def __len__(self) -> int:
        return 40

    def __getitem__(self, index: int) -> Pair:
        whole = picture(1024)
        homography = np.array([[1.0, 0, 256], [0, 1, 256], [0, 0, 1]])
        seen = whole[128:-128, 128:-128]
        return Pair(str(index), np.repeat(whole[..., None], 3, 2), whole[256:768, 256:768], homography, surround=seen)


@pytest.mark.parametrize("kind", NOISE.kinds)
def test_the_truth_is_where_the_noisy_frame_lies_to_sub_pixel(kind: str) -> None:
    """The frame is registered on the window seen through the truth, by maximal correlation (ECC) over homographies:
    what is left must be the identity. A truth that is only nearly consistent would show by pixels."""
    worst = 0.0
    for index in range(3):
        pair = Noisy(One(), NOISE, 3, kind)[index]
        size = (512, 512)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpPerspective(pair.satellite[..., 0], pair.homography, size, flags=flags)
        valid = (pair.thermal > 0).mean()
        assert valid > 0.999, "the surround fills the corners"
        start = np.eye(3, dtype=np.float32)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 1e-7)
        correlation, left = cv2.findTransformECC(seen, pair.thermal, start, cv2.MOTION_HOMOGRAPHY, criteria)
        assert correlation > 0.995
        corners = geometry.edge_corners(512)
        worst = max(worst, float(np.linalg.norm(geometry.apply(left.astype(float), corners) - corners, axis=1).max()))
    assert worst < 0.25, worst


def test_an_inconsistent_truth_would_fail_that_test() -> None:
    """The published rule for perspective moves the frame's corners as if it were the whole 768 px picture: pixels apart."""
    rng = np.random.default_rng(1)
    relation = draw(NOISE, "perspective", 768, rng)  # what the picture sees
    corners = geometry.edge_corners(512)
    moved = geometry.apply(relation, corners + 128) - 128
    said = geometry.apply(draw(NOISE, "perspective", 512, np.random.default_rng(1)), corners)
    assert np.linalg.norm(moved - said, axis=1).max() > 3


def test_bounds_and_centres_of_each_kind() -> None:
    edges, middle = geometry.edge_corners(512), np.array([255.5, 255.5])
    angles, scales, moves = [], [], []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        turned = geometry.apply(draw(NOISE, "rotation", 512, rng), edges)
        assert turned.mean(0) == pytest.approx(middle, abs=1e-6)
        angles.append(np.degrees(np.arctan2(*(turned[1] - turned[0])[::-1])))
        scaled = geometry.apply(draw(NOISE, "scale", 512, rng), edges)
        assert scaled.mean(0) == pytest.approx(middle, abs=1e-6)
        scales.append((scaled[1] - scaled[0])[0] / 512)
        moved = geometry.apply(draw(NOISE, "perspective", 512, rng), edges) - edges
        moves.append(moved / 2)  # pixels of the 256 px input
    assert -30 <= min(angles) < -28 and 28 < max(angles) <= 30
    assert 0.7 <= min(scales) < 0.72 and 1.28 < max(scales) <= 1.3
    moves = np.array(moves)
    assert np.abs(moves - moves.round()).max() < 1e-6 and moves.min().round() == -32 and moves.max().round() == 32
    assert np.array_equal(draw(NOISE, "none", 512, np.random.default_rng(0)), np.eye(3))


def test_published_scale_and_rotation_move_the_truth_as_the_published_code_does() -> None:
    """Scale f: every corner moves inwards by 128 (1 - f) of 256 px. Rotation: about the quad's own middle."""
    pair = One()[0]
    rng = np.random.default_rng(5)
    relation = draw(Noise(scale=0.3), "scale", 512, rng)
    f = relation[0, 0]
    before, after = pair.quad(), warp(pair, relation).quad()
    assert after - before == pytest.approx((1 - f) * 256 * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]]), abs=1e-6)


def test_draws_are_seeded_and_all_kinds_come_in_training() -> None:
    first, again, other = (Noisy(One(), NOISE, seed) for seed in (3, 3, 4))
    assert np.array_equal(first[5].thermal, again[5].thermal) and np.array_equal(first[5].homography, again[5].homography)
    assert any(not np.array_equal(first[i].homography, other[i].homography) for i in range(3))
    kinds = {"none": 0, "rotation": 0, "scale": 0, "perspective": 0}
    for i in range(32):
        h = first[i].homography
        kind = "perspective" if abs(h[2, :2]).max() > 1e-9 else "none"
        if kind == "none" and not np.array_equal(h, One()[i].homography):
            kind = "rotation" if abs(h[1, 0]) > 1e-9 else "scale"
        kinds[kind] += 1
    assert min(kinds.values()) >= 3, kinds


def test_what_was_seen_moves_with_the_frame() -> None:
    """A hole in the surround is a hole in the turned frame; without a surround the corners are unseen."""
    pair = One()[0]
    assert Noisy(One(), NOISE, 3, "rotation")[0].seen is None, "the surround fills the frame"
    relation = draw(Noise(rotation_deg=30), "rotation", 512, np.random.default_rng(2))
    bare = warp(dataclasses.replace(pair, surround=None), relation)
    assert np.array_equal(bare.frame_seen, bare.seen) and 0.8 < bare.seen.mean() < 0.99
    inside, outside = (cv2.erode(part.astype(np.uint8), np.ones((5, 5))) > 0 for part in (bare.seen, ~bare.seen))
    assert (bare.thermal[inside] > 0).all() and not bare.thermal[outside].any()
    hole = np.ones(pair.surround.shape, bool)
    hole[300:340, 420:460] = False
    holed = dataclasses.replace(pair, seen=hole)
    assert holed.frame_seen.shape == (512, 512) and (~holed.frame_seen).sum() == 1600
    moved = warp(holed, relation)
    at = np.argwhere(~moved.seen).mean(0)[::-1]
    assert geometry.apply(relation, at) == pytest.approx([439.5 - 128, 319.5 - 128], abs=0.5)


def test_a_kind_without_a_bound_is_an_error() -> None:
    with pytest.raises(ValueError, match="noise: scale: expected one of"):
        Noisy(One(), Noise(rotation_deg=5), 0, "scale")
