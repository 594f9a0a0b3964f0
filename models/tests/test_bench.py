"""What `make bench` compares must be the same work: OpenCV's steps against the numpy pipeline's and nightfix's own."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from sthn import correlate, geometry

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))
import steps_opencv  # noqa: E402


@pytest.fixture
def picture() -> np.ndarray:
    """A smooth colour picture, 400 x 400 px."""
    noise = np.random.default_rng(5).integers(0, 256, (400, 400, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX)


@pytest.mark.parametrize("size_px, width_m", [(60, 120.0), (48, 128.0), (100, 100.0)])
def test_the_crop_is_the_pipelines(picture: np.ndarray, size_px: int, width_m: float):
    coarse = correlate.CoarseResult(np.array([171.3, 180.7]), 7.0, 1.04, {}, np.zeros((4, 2)))
    margin, side = 20.0, 80
    expected = correlate.oriented_crop(picture, margin, coarse, size_px, width_m)
    quad = correlate.similarity_quad(coarse.centre, coarse.rotation_deg, coarse.scale, side)
    homography = geometry.homography_of_edges(side, quad)
    spec = {"size_px": size_px, "width_m": width_m, "resize": "supersample"}
    manifest = {"refine": {"map": spec}, "window_margin_m": margin, "frame_width_m": float(side)}
    found = steps_opencv.crop(picture, *steps_opencv.crop_grid(manifest, homography))
    assert found.shape == (1, 3, size_px, size_px)
    # Where the crop lies on the picture: outside, OpenCV blends with black over one pixel more.
    assert np.abs(found[0] - expected)[:, 2:-2, 2:-2].max() < 0.02


def test_the_window_is_the_map_where_it_should_be(picture: np.ndarray):
    affine = np.array([[0.99, 0.1, 60.3], [-0.1, 0.99, 95.8]])
    x, y = np.meshgrid(np.arange(200), np.arange(200))
    at = affine @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    expected = correlate.bilinear(picture.astype(float), *at).reshape(200, 200, 3)
    found = steps_opencv.window(picture, affine, 200)
    assert np.abs(found - expected).max() < 4


def test_rectification_turns_clockwise_by_yaw():
    frame = np.random.default_rng(6).integers(0, 256, (65, 65)).astype(np.uint8)
    # Image up is east at a yaw of 90 degrees: what is up in the frame is right in the square.
    np.testing.assert_array_equal(steps_opencv.rectify(frame, 1.0, 0.0, 65), frame)
    np.testing.assert_array_equal(steps_opencv.rectify(frame, 1.0, 90.0, 65), np.rot90(frame, -1))


def test_homographies_are_those_of_the_pipeline():
    edges = geometry.edge_corners(512)
    quad = edges * 1.1 + np.array([[100.0, 30.0], [90.0, 25.0], [104.0, 33.0], [99.0, 31.0]])
    np.testing.assert_allclose(steps_opencv.dlt(edges, quad), geometry.dlt(edges, quad), rtol=1e-4, atol=1e-6)
