"""Identity, and keypoints with a robust homography, by OpenCV: SIFT, ORB, BRISK with RANSAC or MAGSAC++.

OpenCV 5 moved BRISK to its contrib modules; where they are missing its row says so.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.pair import Pair
from .base import MIN_MATCHES, Match, Rival, RivalError, Unready, centred

RATIO = 0.75
"""A match is kept where its distance is below this share of the second best's (Lowe 2004, Sec. 7.1)."""

REPROJECTION_PX = 5.0
"""Inlier threshold of both estimators, window pixels (1 m)."""

ESTIMATORS: dict[str, tuple[str, int]] = {"ransac": ("RANSAC", cv2.RANSAC), "magsac": ("MAGSAC++", cv2.USAC_MAGSAC)}
ITERATIONS = 10_000
CONFIDENCE = 0.999


def _brisk() -> Callable[[], cv2.Feature2D] | None:
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        if hasattr(module, "BRISK_create"):
            return module.BRISK_create
    return None


DETECTORS: dict[str, tuple[str, Callable[[], cv2.Feature2D] | None, int]] = {
    "sift": ("SIFT", lambda: cv2.SIFT_create(), cv2.NORM_L2),
    "orb": ("ORB", lambda: cv2.ORB_create(nfeatures=5000), cv2.NORM_HAMMING),
    "brisk": ("BRISK", _brisk(), cv2.NORM_HAMMING),
}
"""Key -> printed name, detector, norm of its descriptors."""


class Identity:
    """The frame in the middle of the window, unturned: the prior itself."""

    name = "identity"
    window_m: int | None = None
    note = ""
    ready = True

    def match(self, pair: Pair) -> Match:
        """No look at the pixels."""
        return Match(centred(pair), 0.0)


def robust_homography(
    source: NDArray[np.float64], target: NDArray[np.float64], method: int, threshold_px: float = REPROJECTION_PX
) -> tuple[NDArray[np.float64] | None, dict[str, float | int | str]]:
    """Point pairs `[N, 2]` (frame px, window px) -> a homography, or None with `failure` in the detail."""
    detail: dict[str, float | int | str] = {"matches": len(source)}
    if len(source) <= MIN_MATCHES:
        return None, detail | {"failure": f"{len(source)} matches, more than {MIN_MATCHES} are needed"}
    found, inliers = cv2.findHomography(
        np.ascontiguousarray(source, np.float64),
        np.ascontiguousarray(target, np.float64),
        method,
        threshold_px,
        maxIters=ITERATIONS,
        confidence=CONFIDENCE,
    )
    detail["inliers"] = 0 if inliers is None else int(inliers.sum())
    if found is None or not np.isfinite(found).all():
        return None, detail | {"failure": "no homography agrees with the matches"}
    return found, detail


@dataclass
class Keypoints:
    """Keypoints of both images, nearest neighbours with the ratio test, a robust homography."""

    name: str
    create: Callable[[], cv2.Feature2D]
    norm: int
    method: int
    window_m: int | None = None
    note: str = ""
    ready: bool = True

    def match(self, pair: Pair) -> Match:
        """Both images at 1 m/px, the satellite one in gray."""
        began = time.perf_counter()
        gray = cv2.cvtColor(pair.satellite, cv2.COLOR_RGB2GRAY)
        detector = self.create()
        points, values = detector.detectAndCompute(pair.thermal, None)
        places, others = detector.detectAndCompute(gray, None)
        kept = []
        if values is not None and others is not None and len(others) > 1:
            pairs = cv2.BFMatcher(self.norm).knnMatch(values, others, k=2)
            kept = [two[0] for two in pairs if len(two) == 2 and two[0].distance < RATIO * two[1].distance]
        source = np.array([points[m.queryIdx].pt for m in kept]).reshape(-1, 2)
        target = np.array([places[m.trainIdx].pt for m in kept]).reshape(-1, 2)
        found, detail = robust_homography(source, target, self.method)
        return Match(found, time.perf_counter() - began, detail)


def keypoints(detector: str, estimator: str) -> Rival:
    """`detector` of DETECTORS with `estimator` of ESTIMATORS."""
    if detector not in DETECTORS or estimator not in ESTIMATORS:
        known = f"{', '.join(DETECTORS)} with {', '.join(ESTIMATORS)}"
        raise RivalError(f"keypoints: expected {known}, found {detector} with {estimator}")
    label, create, norm = DETECTORS[detector]
    estimator_label, method = ESTIMATORS[estimator]
    name = f"{label} + {estimator_label}"
    if create is None:
        return Unready(name, f"{label} is not in this OpenCV ({cv2.__version__}): install opencv-contrib-python-headless")
    return Keypoints(name, create, norm, method)
