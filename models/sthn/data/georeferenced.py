"""Pairs from any georeferenced map: alone, with thermal synthesised on the fly, or with a recorded flight over it.

`MapPairs` draws windows and frames anywhere on maps and renders the frames with `sthn.lite.thermal`: for training, and to
try things where no thermal flight exists. `FlightPairs` takes a recorded-flight folder (ARCHITECTURE.md) with truth
columns: each frame is rectified as the service does it and sought in a window round its prior.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..lite import scene, thermal
from .errors import DataError
from .flight import MapWindows, RecordedFlight
from .noise import Seed, words
from .pair import FRAME_PX, Pair

SURROUND = 1.5
"""Side of what is rendered or rectified about a frame, in frames: enough for 30 degrees and 30 %."""

MIN_ON_MAP = 0.9
"""Least share of a frame's ground that lies on the map."""

TRIALS = 100


class MapPairs:
    """`count` pairs over maps. The frame's middle lies uniformly in the disc of D_C about the window's.

    `m_per_px`: scale of window and frame alike, metres of ground a pixel; `frame_px` with it makes small pairs for small
    networks. `augment`: quarter turns, mirroring, colour jitter of the window (training only). `surround`: renders more
    than the frame, for noise.
    """

    def __init__(
        self,
        maps: list[scene.SceneMap],
        window_px: int,
        search_radius_m: float,
        count: int,
        seed: Seed = 0,
        m_per_px: float = 1.0,
        frame_px: int = FRAME_PX,
        augment: bool = False,
        surround: bool = False,
        name: str = "maps",
        style: int | None = None,
    ) -> None:
        if not maps:
            raise DataError(name, "maps", "at least one map", "none")
        for key, value, least in (("window_px", window_px, frame_px), ("count", count, 1), ("frame_px", frame_px, 16)):
            if value < least:
                raise DataError(name, key, f"at least {least}", value)
        self.maps, self.window_m, self.search_radius_m = maps, window_px, float(search_radius_m)
        self.count, self.seed, self.m_per_px, self.frame_px = count, seed, m_per_px, frame_px
        self.augment, self.surround, self.name, self.style = augment, surround, name, style
        areas = np.array([m.size[0] * m.size[1] * m.m_per_px**2 for m in maps])
        self._share = areas / areas.sum()

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Pair:
        if not 0 <= index < self.count:
            raise IndexError(index)
        rng = np.random.default_rng(words(self.seed, index))
        for _ in range(TRIALS):
            drawn = self._draw(rng, index)
            if drawn is not None:
                return drawn
        raise DataError(self.name, "maps", f"a frame at least {MIN_ON_MAP:.0%} on the map in {TRIALS} trials", "none")

    def _draw(self, rng: np.random.Generator, index: int) -> Pair | None:
        place = self.maps[int(rng.choice(len(self.maps), p=self._share))]
        height, width = place.size
        step = self.m_per_px / place.m_per_px
        reach = min(self.frame_px * step / 2, 0.5 * min(height, width) - 1)
        frame_at = np.array([rng.uniform(reach, width - reach), rng.uniform(reach, height - reach)])
        radius, angle = self.search_radius_m * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        shift_px = radius / self.m_per_px * np.array([np.cos(angle), np.sin(angle)])
        turn, mirror = (rng.integers(0, 4) * np.pi / 2, bool(rng.random() < 0.5)) if self.augment else (0.0, False)
        ground = scene.similarity(0, 0, turn, step, mirror)

        def centred(size_px: int) -> NDArray[np.float64]:
            """Pixels of a square -> pixels from its middle."""
            return scene.px_to_m(size_px, size_px)

        to_frame = ground.copy()
        to_frame[:2, 2] = frame_at
        to_window = to_frame.copy()
        to_window[:2, 2] -= ground[:2, :2] @ shift_px
        seen_px = self.frame_px
        if self.surround:
            seen_px += 2 * round((SURROUND - 1) * self.frame_px / 2)
        levels = place.levels
        if place.later and rng.random() < 0.6:
            levels = place.later[int(rng.integers(0, len(place.later)))]
        to_seen = to_frame @ centred(seen_px)
        seen = scene.cut(levels, to_seen, seen_px)
        margin = (seen_px - self.frame_px) // 2
        inner = slice(margin, margin + self.frame_px)
        if (thermal.brightest(seen[inner, inner]) > 0).mean() < MIN_ON_MAP:
            return None
        classes = None
        if place.classes is not None:
            flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            classes = cv2.warpPerspective(place.classes, to_seen, (seen_px, seen_px), flags=flags)
        if self.style is None:
            values = thermal.render(seen, classes, self.m_per_px, rng)
        else:
            values = thermal.tone_curve(seen.astype(np.float32) / 255, np.random.default_rng(self.style))
        gray = thermal.sensor(values, self.m_per_px, rng)
        gray = np.round(gray * 255).astype(np.uint8)
        window = scene.cut(place.levels, to_window @ centred(self.window_m), self.window_m)
        if self.augment:
            on_map = thermal.brightest(window) > 0
            window = np.round(thermal.colour_jitter(window, rng) * 255).astype(np.uint8) * on_map[..., None]
        shift = np.eye(3)
        shift[:2, 2] = shift_px
        return Pair(
            name=f"{place.name}-{index}",
            satellite=window,
            thermal=np.ascontiguousarray(gray[inner, inner]),
            homography=np.linalg.inv(centred(self.window_m)) @ shift @ centred(self.frame_px),
            terrain=place.name,
            m_per_px=self.m_per_px,
            surround=gray if self.surround else None,
        )

    def reseeded(self, seed: Seed) -> MapPairs:
        """Other pairs of the same maps."""
        other = object.__new__(MapPairs)
        other.__dict__.update(self.__dict__ | {"seed": seed})
        return other


class FlightPairs:
    """The frames of a recorded flight with truth, each in a window about its prior.

    The prior is the row's where it has one within D_C of the truth and `own_priors` is set, else drawn uniformly in the
    disc of D_C about the truth. Windows are north-up in ground metres at their middle, as the service makes them.
    `surround`: rectifies more than the frame, for noise.
    """

    def __init__(
        self,
        flight: RecordedFlight,
        satellite: Path,
        window_px: int,
        search_radius_m: float,
        seed: Seed = 0,
        m_per_px: float = 1.0,
        own_priors: bool = False,
        surround: bool = False,
    ) -> None:
        self.flight, self.windows = flight, MapWindows(satellite)
        self.window_m, self.search_radius_m, self.seed = window_px, float(search_radius_m), seed
        self.m_per_px, self.own_priors, self.name = m_per_px, own_priors, flight.name
        self.surround = surround
        self.rows = [row for row in flight.rows if row.truth is not None]
        if not self.rows:
            raise DataError(flight.folder / "poses.csv", "truth_lat_deg", "at least one row with truth", "none")

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Pair:
        row = self.rows[index]
        rng = np.random.default_rng(words(self.seed, index))
        centre = row.prior if self.own_priors else None
        if centre is None or np.hypot(*self.windows.offset_m(row.truth, centre)) > self.search_radius_m:
            radius, angle = self.search_radius_m * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
            centre = self.windows.moved(row.truth, radius * np.sin(angle), radius * np.cos(angle))
        east, north = self.windows.offset_m(centre, row.truth)
        margin = round((SURROUND - 1) * FRAME_PX / 2) if self.surround else 0
        rectified = self.flight.rectified(row, FRAME_PX + 2 * margin, self.m_per_px)
        inner = slice(margin, margin + FRAME_PX)
        # What is known of the attitude places the vehicle in the rectified frame; the truth places it in the window.
        turn = 0.0 if row.truth_yaw_deg is None else np.radians(row.truth_yaw_deg - rectified.yaw_deg)
        middle = np.array([east, -north]) / self.m_per_px + (self.window_m - 1) / 2
        to_vehicle = np.eye(3)
        to_vehicle[:2, 2] = margin - np.asarray(rectified.vehicle_px)
        return Pair(
            name=row.file,
            satellite=self.windows.window(centre, self.window_m, self.m_per_px),
            thermal=np.ascontiguousarray(rectified.pixels[inner, inner]),
            homography=scene.similarity(*middle, turn, 1.0, False) @ to_vehicle,
            m_per_px=self.m_per_px,
            surround=rectified.pixels if self.surround else None,
            seen=None if rectified.seen.all() else rectified.seen,
        )

    def reseeded(self, seed: Seed) -> FlightPairs:
        """Other priors for the same frames."""
        other = object.__new__(FlightPairs)
        other.__dict__.update(self.__dict__ | {"seed": seed})
        return other
