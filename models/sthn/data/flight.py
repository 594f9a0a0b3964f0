"""A recorded flight in Python, and north-up windows of a georeferenced map: what the service does, for training.

The contract is ARCHITECTURE.md, "Recorded flight"; the optics are those of `src/thermal/rectify.rs`.
"""

from __future__ import annotations

import csv
import math
import os
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Geod, Transformer
from rasterio.enums import Resampling
from rasterio.windows import Window
from scipy.spatial.transform import Rotation

from ..tone import tone_map
from .errors import DataError

WGS84 = Geod(ellps="WGS84")
LatLon = tuple[float, float]

HEADER_KEYS = {"schema", "name", "map", "notes", "camera"}
CAMERA_KEYS = {"hfov_deg", "mount_roll_deg", "mount_pitch_deg", "mount_yaw_deg"}


@dataclass(frozen=True)
class Row:
    """One frame. None is unknown, never zero."""

    file: str
    numbers: dict[str, float]
    """Every other known column."""

    def _position(self, kind: str) -> LatLon | None:
        lat, lon = self.numbers.get(f"{kind}_lat_deg"), self.numbers.get(f"{kind}_lon_deg")
        return None if lat is None or lon is None else (lat, lon)

    @property
    def truth(self) -> LatLon | None:
        """True position of the vehicle."""
        return self._position("truth")

    @property
    def prior(self) -> LatLon | None:
        """Middle of the prior."""
        return self._position("prior")

    @property
    def truth_yaw_deg(self) -> float | None:
        """Of the camera's image up, clockwise from true north."""
        return self.numbers.get("truth_yaw_deg")


@dataclass(frozen=True)
class Rectified:
    """A frame as a north-up square of ground."""

    pixels: NDArray[np.uint8]
    """0 where unseen."""
    seen: NDArray[np.bool_]
    """Where the sensor saw the ground: half a pixel round its outermost centres included, in front of the camera."""
    vehicle_px: tuple[float, float]
    """The point under the vehicle."""
    yaw_deg: float
    """The camera's yaw that was assumed."""


@dataclass(frozen=True)
class RecordedFlight:
    """A folder of `flight.toml`, `poses.csv` and frames."""

    folder: Path
    name: str
    rows: list[Row]
    camera: dict[str, float] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path) -> RecordedFlight:
        """Reads the tables; frames are opened when they are asked for."""
        folder = Path(folder)
        path = folder / "flight.toml"
        try:
            header = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(path, "file", "a readable flight.toml", error) from error
        camera = header.get("camera", {})
        for table, known, prefix in ((header, HEADER_KEYS, ""), (camera, CAMERA_KEYS, "camera.")):
            if unknown := sorted(table.keys() - known):
                raise DataError(path, prefix + unknown[0], f"one of {', '.join(sorted(known))}", "an unknown key")
        rows = _read_rows(folder / "poses.csv")
        return cls(folder, header.get("name", folder.name), rows, {k: float(v) for k, v in camera.items()})

    def gray(self, row: Row) -> NDArray[np.uint8]:
        """A row's frame, 8 bit; 16-bit ones by the service's tone mapping."""
        path = self.folder / row.file
        image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise DataError(path, "file", "a frame as PNG, TIFF or JPEG", "nothing that can be decoded")
        return tone_map(image)

    def rectified(self, row: Row, size_px: int, m_per_px: float) -> Rectified:
        """A row's frame as a north-up nadir square about where the optical axis meets the ground; 0 where unseen."""
        frame = self.gray(row)
        frame_from_square, vehicle_px, yaw_deg = self._view(row, frame.shape, size_px, m_per_px)
        middle = frame_from_square @ [(size_px - 1) / 2, (size_px - 1) / 2, 1.0]
        step = max(1, round(math.sqrt(abs(np.linalg.det(frame_from_square) / middle[2] ** 3))))
        height, width = (n // step for n in frame.shape)
        left, top = (frame.shape[1] - width * step) // 2, (frame.shape[0] - height * step) // 2
        inner = frame[top : top + height * step, left : left + width * step]
        reduced = cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA) if step > 1 else inner
        half = (step - 1) / 2
        to_reduced = np.array([[1 / step, 0, -(left + half) / step], [0, 1 / step, -(top + half) / step], [0, 0, 1]])
        to_reduced = to_reduced @ frame_from_square
        flags, size = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, (size_px, size_px)
        pixels = cv2.warpPerspective(reduced, to_reduced, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        at = np.arange(size_px)
        x, y, depth = (row[0] * at[None] + row[1] * at[:, None] + row[2] for row in to_reduced)
        seen = depth > 1e-3 * (to_reduced[2] @ [(size_px - 1) / 2, (size_px - 1) / 2, 1.0])
        for value, most in ((x, width - 0.5), (y, height - 0.5)):
            seen &= (value >= -0.5 * depth) & (value <= most * depth)
        return Rectified(pixels * seen, seen, vehicle_px, yaw_deg)

    def _view(
        self, row: Row, shape: tuple[int, ...], size_px: int, m_per_px: float
    ) -> tuple[NDArray[np.float64], tuple[float, float], float]:
        """Square px -> frame px; the vehicle in the square; the camera's yaw. A pinhole over flat ground, FRD, ZYX."""
        known, height_px, width_px = row.numbers, shape[0], shape[1]
        if "yaw_deg" not in known:
            raise DataError(self.folder / "poses.csv", f"{row.file}: yaw_deg", "degrees clockwise from true north", "nothing")
        vehicle = Rotation.from_euler("ZYX", [known.get(f"{a}_deg", 0.0) for a in ("yaw", "pitch", "roll")], degrees=True)
        mount = [self.camera.get(f"mount_{axis}_deg", 0.0) for axis in ("yaw", "pitch", "roll")]
        camera = vehicle * Rotation.from_euler("ZYX", mount, degrees=True)
        to_ned = camera.as_matrix()
        focal = None
        if "hfov_deg" in self.camera:
            focal = width_px / 2 / math.tan(math.radians(self.camera["hfov_deg"]) / 2)
        gsd, agl = known.get("gsd_m"), known.get("agl_m")
        if gsd is None and (agl is None or focal is None):
            raise DataError(self.folder / "poses.csv", f"{row.file}: gsd_m", "a number, or agl_m with camera.hfov_deg", "neither")
        if gsd is not None:
            height = agl or (gsd * focal if focal else None)
            if height is None:
                if to_ned[2, 2] < 1 - 1e-12:
                    raise DataError(self.folder / "poses.csv", f"{row.file}: agl_m", "agl_m or hfov_deg, as it tilts", "neither")
                height = gsd
            focal = height / gsd
        else:
            height = agl
        axis = to_ned[:, 2] * (height / to_ned[2, 2])
        middle = (size_px - 1) / 2
        ned = np.array([[0, -m_per_px, axis[0] + m_per_px * middle], [m_per_px, 0, axis[1] - m_per_px * middle], [0, 0, height]])
        body = np.array([[0, focal, (width_px - 1) / 2], [-focal, 0, (height_px - 1) / 2], [0, 0, 1]])
        vehicle_px = (middle - axis[1] / m_per_px, middle + axis[0] / m_per_px)
        return body @ to_ned.T @ ned, vehicle_px, math.degrees(math.atan2(to_ned[1, 0], to_ned[0, 0]))


def _read_rows(path: Path) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = list(csv.DictReader(file))
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(path, "file", "a readable poses.csv", error) from error
    rows = []
    for number, line in enumerate(lines, 1):
        if not line.get("file"):
            raise DataError(path, f"row {number}: file", "a path relative to the folder", "nothing")
        numbers = {}
        for column, text in line.items():
            if column and text and column.endswith(("_deg", "_m")):
                try:
                    numbers[column] = float(text)
                except ValueError:
                    raise DataError(path, f"row {number}: {column}", "a number", repr(text)) from None
        if any(not math.isfinite(value) for value in numbers.values()):
            raise DataError(path, f"row {number}", "finite numbers", "NaN or infinity")
        rows.append(Row(line["file"], numbers))
    return rows


class MapWindows:
    """North-up windows of a georeferenced map, in ground metres about their middle. The file is opened once per process:
    a forked loader's workers would move one another's place in it."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._handle: tuple[int, rasterio.DatasetReader] | None = None
        self._file()

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_handle": None}

    def _file(self) -> rasterio.DatasetReader:
        if self._handle is not None and self._handle[0] == os.getpid():
            return self._handle[1]
        try:
            source = rasterio.open(self.path)
        except rasterio.errors.RasterioIOError as error:
            raise DataError(self.path, "file", "a GeoTIFF", error) from error
        if source.crs is None:
            raise DataError(self.path, "CRS", "a coordinate reference system", "none")
        self._handle = os.getpid(), source
        return source

    @staticmethod
    def offset_m(start: LatLon, end: LatLon) -> tuple[float, float]:
        """East and north from start to end, along the geodesic, metres."""
        azimuth, _, length = WGS84.inv(start[1], start[0], end[1], end[0])
        return length * math.sin(math.radians(azimuth)), length * math.cos(math.radians(azimuth))

    @staticmethod
    def moved(start: LatLon, east_m: float, north_m: float) -> LatLon:
        """A position east and north of another."""
        lon, lat, _ = WGS84.fwd(start[1], start[0], math.degrees(math.atan2(east_m, north_m)), math.hypot(east_m, north_m))
        return lat, lon

    def window(self, centre: LatLon, size_px: int, m_per_px: float) -> NDArray[np.uint8]:
        """`[size, size, 3]`, RGB; zero where there is no map."""
        source = self._file()
        ground = CRS.from_proj4(f"+proj=aeqd +lat_0={centre[0]!r} +lon_0={centre[1]!r} +ellps=WGS84 +units=m")
        nodes = np.linspace(0, size_px - 1, 33)
        offset = (nodes - (size_px - 1) / 2) * m_per_px
        east, south = np.meshgrid(offset, offset)
        x, y = Transformer.from_crs(ground, source.crs, always_xy=True).transform(east, -south)
        a = ~source.transform
        column, row = a.a * x + a.b * y + a.c - 0.5, a.d * x + a.e * y + a.f - 0.5
        left, top = math.floor(column.min()) - 2, math.floor(row.min()) - 2
        right, bottom = math.ceil(column.max()) + 3, math.ceil(row.max()) + 3
        left, top, right, bottom = max(left, 0), max(top, 0), min(right, source.width), min(bottom, source.height)
        if left >= right or top >= bottom:
            return np.zeros((size_px, size_px, 3), np.uint8)
        # A map finer than the window is averaged as it is read.
        step = math.sqrt(abs(np.ptp(column) * np.ptp(row))) / (size_px - 1)
        shape = tuple(max(1, round(n / max(1.0, step))) for n in (bottom - top, right - left))
        part = Window(left, top, right - left, bottom - top)
        bands = [1, 2, 3] if source.count >= 3 else [1, 1, 1]
        pixels = np.moveaxis(source.read(bands, window=part, out_shape=(3, *shape), resampling=Resampling.average), 0, -1)
        pixels = pixels * (source.dataset_mask(window=part, out_shape=shape) > 0)[..., None].astype(np.uint8)
        spread = np.clip(1 - np.abs(np.arange(size_px)[:, None] - nodes) / (nodes[1] - nodes[0]), 0, None)
        coordinates = []
        for at, first, count, full in ((column, left, shape[1], right - left), (row, top, shape[0], bottom - top)):
            coordinates.append((spread @ ((at - first + 0.5) * (count / full) - 0.5) @ spread.T).astype(np.float32))
        return cv2.remap(np.ascontiguousarray(pixels), *coordinates, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
