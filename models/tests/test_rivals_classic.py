"""Identity and OpenCV's keypoints behind the rivals' interface."""

import cv2
import numpy as np
import pytest

from sthn import geometry, rivals
from sthn.data.pair import Pair
from sthn.rivals import classic


def easy_pair(
    turn_deg: float = 7.0, shift: tuple[float, float] = (20.0, -12.0), frame_px: int = 256, window_px: int = 400
) -> Pair:
    """Gray blocks in the window and the frame cut from it: same spectrum, so that keypoints can match."""
    rng = np.random.default_rng(3)
    scene = np.full((window_px, window_px), 90, np.uint8)
    for _ in range(250):
        box = cv2.boxPoints((tuple(rng.uniform(0, window_px, 2)), tuple(rng.uniform(6, 50, 2)), rng.uniform(0, 90)))
        cv2.fillPoly(scene, [box.astype(np.int32)], int(rng.integers(10, 245)))
    scene = cv2.GaussianBlur(scene, (0, 0), 0.8)
    half, middle = (frame_px - 1) / 2, (window_px - 1) / 2
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    to = np.array([[1, 0, middle + shift[0]], [0, 1, middle + shift[1]], [0, 0, 1.0]])
    homography = to @ turn @ np.array([[1, 0, -half], [0, 1, -half], [0, 0, 1.0]])
    frame = cv2.warpPerspective(scene, homography, (frame_px, frame_px), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return Pair("easy", np.repeat(scene[..., None], 3, 2), frame, homography)


def corner_error_m(pair: Pair, homography: np.ndarray) -> float:
    corners = geometry.edge_corners(pair.thermal.shape[0])
    return float(np.linalg.norm(geometry.apply(homography, corners) - pair.quad(), axis=1).mean())


def test_identity_lays_the_frame_in_the_middle() -> None:
    pair = easy_pair(0.0, (0.0, 0.0))
    (identity,) = rivals.available(["identity"])
    assert corner_error_m(pair, identity.match(pair).homography) < 1e-9
    moved = easy_pair(0.0, (30.0, -40.0))
    assert corner_error_m(moved, identity.match(moved).homography) == pytest.approx(50.0)


@pytest.mark.parametrize("estimator", classic.ESTIMATORS)
@pytest.mark.parametrize("detector", classic.DETECTORS)
def test_keypoints_find_a_frame_of_the_same_spectrum(detector: str, estimator: str) -> None:
    (rival,) = rivals.available([f"{detector}+{estimator}"])
    pair = easy_pair()
    if not rival.ready:
        assert detector == "brisk" and "contrib" in rival.note
        with pytest.raises(rivals.RivalError, match="BRISK"):
            rival.match(pair)
        return
    match = rival.match(pair)
    assert not match.failed and match.seconds > 0
    assert corner_error_m(pair, match.homography) < 0.5
    assert match.detail["inliers"] > rivals.MIN_MATCHES
    again = rival.match(pair)
    np.testing.assert_array_equal(match.homography, again.homography)


def test_flat_frame_fails_and_is_no_exception() -> None:
    pair = easy_pair()
    flat = Pair("flat", pair.satellite, np.full_like(pair.thermal, 90), pair.homography)
    match = rivals.available(["sift+ransac"])[0].match(flat)
    assert match.failed and match.detail["matches"] == 0 and "0 matches" in match.detail["failure"]


@pytest.mark.parametrize("count, fails", [(10, True), (11, False)])
def test_the_papers_failure_rule(count: int, fails: bool) -> None:
    source = np.random.default_rng(0).uniform(0, 500, (count, 2))
    found, _ = classic.robust_homography(source, source + 5.0, cv2.RANSAC)
    assert (found is None) == fails


def test_unknown_names_and_paths_are_named() -> None:
    with pytest.raises(rivals.RivalError, match="unknown surf; expected identity, sift"):
        rivals.available(["surf"])
    with pytest.raises(rivals.RivalError, match="unknown paths surf"):
        rivals.available(["identity"], surf="somewhere")
