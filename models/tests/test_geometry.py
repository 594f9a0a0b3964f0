"""Corners, edges and the DLT; OpenCV as oracle."""

import cv2
import numpy as np
import pytest

from sthn import geometry

QUAD = np.array([[400.0, 410.0], [930.0, 395.0], [380.0, 905.0], [915.0, 940.0]])


def test_the_dlt_is_opencvs() -> None:
    square = geometry.edge_corners(512)
    expected = cv2.getPerspectiveTransform(square.astype(np.float32), QUAD.astype(np.float32))
    found = geometry.dlt(square, QUAD)
    points = np.random.default_rng(0).uniform(0, 512, (50, 2))
    assert np.abs(geometry.apply(found, points) - geometry.apply(expected, points)).max() < 1e-4  # OpenCV's points are f32
    assert np.abs(geometry.apply(found, square) - QUAD).max() < 1e-9


def test_more_points_are_fitted() -> None:
    truth = geometry.dlt(geometry.edge_corners(512), QUAD)
    generator = np.random.default_rng(1)
    points = generator.uniform(0, 512, (200, 2))
    found = geometry.dlt(points, geometry.apply(truth, points) + generator.normal(0, 0.1, (200, 2)))
    assert np.abs(geometry.apply(found, geometry.edge_corners(512)) - QUAD).max() < 0.2


@pytest.mark.parametrize(
    "bad", [np.zeros((4, 2)), np.arange(8.0).reshape(4, 2), np.full((4, 2), np.nan), np.zeros((3, 2))], ids=str
)
def test_degenerate_points_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="homography"):
        geometry.dlt(geometry.edge_corners(512)[: len(bad)], bad)


@pytest.mark.parametrize("width_m", [512, 1024, 1536])
def test_a_perfect_fit_has_scale_one(width_m: int) -> None:
    """Truth of the published data: a centred frame has its corners at 0 / 64 / 85.33 and 255 / 191 / 169.67 of 256."""
    alpha = width_m / 256
    low = (width_m - 512) / 2 / alpha
    quad = geometry.RIGHT_BOTTOM * (255 - 2 * low) + low
    displacement = geometry.displacement_of(256, quad)
    homography = geometry.homography_of_displacement(512, 256, displacement, alpha)
    assert np.abs(homography[:2, :2] - np.eye(2)).max() < 1e-12
    middle = geometry.apply(homography, [255.5, 255.5])
    assert np.abs(middle - (width_m - 1) / 2).max() < 1e-9


def test_there_and_back() -> None:
    displacement = np.random.default_rng(2).normal(0, 20, (2, 2, 2))
    quad = geometry.edges_of_inclusive(geometry.displaced(256, displacement), 6.0, 32.0)
    back = geometry.displacement_of(256, geometry.inclusive_of_edges(quad, 6.0, 32.0))
    assert np.abs(back - displacement).max() < 1e-9
    assert geometry.displaced(256, displacement)[1, 0] == 255 + displacement[0, 0, 1]
    assert geometry.displaced(256, displacement)[2, 1] == 255 + displacement[1, 1, 0]
