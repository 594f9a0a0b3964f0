"""The Boson-nighttime data set in its published layout, and any other laid out so.

    DIR/{train,val,test,extended}_queries.h5     frames, at least 512 x 512 px, 1 m/px
    DIR/{train,val,test,extended}_database.h5    centres of windows (its images are not read)
    MAP.png                                      the big satellite map, without CRS, that windows are cropped from

Each HDF5 file has `image_data` u8 `[N, H, W, 3]` (lzf, one chunk an image), `image_size` `[N, 2]` and `image_name`, text
"@row@column": **row first**, pixels of the big map, top-left origin. A second image at one place has 1e-5 more in its
column, a third 2e-5. A frame or window of n pixels about (row, column) begins n / 2 before it, so that its middle lies at
(row - 0.5, column - 0.5).

`extended_queries.h5` of the third release holds the test region: `extended_queries_test_excluded.h5` is taken where it
is there, and the plain file is refused for training unless asked for.
"""

from __future__ import annotations

import functools
import json
import os
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from .errors import DataError
from .noise import Seed, words
from .pair import FRAME_PX, Pair

MAP_NAME = "maps/satellite/20201117_BingSatellite.png"
"""Where the published map lies, beside the folders of the splits' files."""

DUPLICATE_STEP = 1e-5
SPLITS = ("train", "val", "test", "extended")
PAIRS_SCHEMA = 1

Purpose = Literal["train", "evaluate"]

_NAME = re.compile(r"^@(-?\d+(?:\.\d+)?)@(-?\d+(?:\.\d+)?)@?$")


class ImageFile:
    """One HDF5 file. Opened when first read, once per process: handles do not survive a fork."""

    def __init__(self, path: Path, images: bool = True) -> None:
        self.path = Path(path)
        self._handle: tuple[int, h5py.File] | None = None
        file = self._file()
        self.names, self.positions = _read_names(self.path, file)
        """Positions: `[N, 2]`, row and column in the big map."""
        self.size_px = _check_images(self.path, file, len(self.names)) if images else (0, 0)
        """Height and width."""

    def __len__(self) -> int:
        return len(self.names)

    def _file(self) -> h5py.File:
        if self._handle is None or self._handle[0] != os.getpid():
            try:
                self._handle = os.getpid(), h5py.File(self.path, "r")
            except OSError as error:
                raise DataError(self.path, "file", "a readable HDF5 file", error) from error
        return self._handle[1]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_handle": None}

    def image(self, index: int) -> NDArray[np.uint8]:
        """`[H, W, 3]`."""
        return self._file()["image_data"][index]

    def gray(self, index: int) -> NDArray[np.uint8]:
        """`[H, W]`, as the published pipeline converts it (ITU-R 601; three equal channels stay as they are)."""
        return np.asarray(Image.fromarray(self.image(index)).convert("L"))


def _read_names(path: Path, file: h5py.File) -> tuple[list[str], NDArray[np.float64]]:
    names = file.get("image_name")
    if not isinstance(names, h5py.Dataset) or names.ndim != 1 or h5py.check_string_dtype(names.dtype) is None:
        raise DataError(path, "image_name", "text [N]", _shape(names))
    try:
        texts = [str(text) for text in names.asstr("utf-8")[()]]
    except UnicodeDecodeError as error:
        raise DataError(path, "image_name", "UTF-8", error) from error
    positions = np.empty((len(texts), 2))
    for i, text in enumerate(texts):
        found = _NAME.match(text)
        if not found:
            raise DataError(path, f"image_name[{i}]", '"@row@column"', repr(text))
        positions[i] = float(found[1]), float(found[2])
    if len(set(texts)) != len(texts):
        twice = Counter(texts).most_common(1)[0][0]
        raise DataError(path, "image_name", "distinct names (1e-5 more for a second image)", f"{twice} twice")
    return texts, positions


def _check_images(path: Path, file: h5py.File, count: int) -> tuple[int, int]:
    images, sizes = file.get("image_data"), file.get("image_size")
    if not isinstance(images, h5py.Dataset) or images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise DataError(path, "image_data", "uint8 [N, H, W, 3]", _shape(images))
    if images.shape[0] != count:
        raise DataError(path, "image_data", f"{count} images, as image_name has", images.shape[0])
    if not isinstance(sizes, h5py.Dataset) or sizes.shape != (count, 2):
        raise DataError(path, "image_size", f"[{count}, 2]", _shape(sizes))
    if count and (np.asarray(sizes[()]) != images.shape[1:3]).any():
        raise DataError(path, "image_size", f"{images.shape[1:3]} for every image", sizes[()].tolist()[:3])
    return images.shape[1], images.shape[2]


def _shape(value: object) -> str:
    return f"{value.dtype} {list(value.shape)}" if isinstance(value, h5py.Dataset) else "nothing"


class MapImage:
    """The big map in memory, one copy a process and file."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.size_px = self.pixels().shape[:2]
        """Height and width."""

    def pixels(self) -> NDArray[np.uint8]:
        """`[H, W, 3]`, RGB."""
        return _read_map(self.path)

    def crop(self, row: int, column: int, side: int) -> NDArray[np.uint8]:
        """`[side, side, 3]` that begins side / 2 before (row, column); zero outside the map."""
        pixels, out = self.pixels(), np.zeros((side, side, 3), np.uint8)
        top, left = row - side // 2, column - side // 2
        rows = slice(max(top, 0), min(top + side, pixels.shape[0]))
        columns = slice(max(left, 0), min(left + side, pixels.shape[1]))
        if rows.start < rows.stop and columns.start < columns.stop:
            out[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[rows, columns]
        return out


@functools.lru_cache(maxsize=2)
def _read_map(path: Path) -> NDArray[np.uint8]:
    if not path.is_file():
        raise DataError(path, "file", "the satellite map as an image", "nothing")
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise DataError(path, "file", "the satellite map as an image", "a file that cannot be decoded")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


@dataclass(frozen=True)
class Chosen:
    """Pairs written down: which query with which database centre, by name."""

    search_radius_m: float
    queries: tuple[str, ...]
    database: tuple[str, ...]

    def save(self, path: Path) -> None:
        """As `pairs.json`."""
        pairs = list(zip(self.queries, self.database, strict=True))
        document = {"schema": PAIRS_SCHEMA, "search_radius_m": self.search_radius_m, "pairs": pairs}
        Path(path).write_text(json.dumps(document, indent=0) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> Chosen:
        """Of `pairs.json`."""
        try:
            document = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(path, "file", "a readable pairs.json", error) from error
        if not isinstance(document, dict) or document.get("schema") != PAIRS_SCHEMA:
            found = document.get("schema") if isinstance(document, dict) else type(document).__name__
            raise DataError(path, "schema", str(PAIRS_SCHEMA), found)
        radius, pairs = document.get("search_radius_m"), document.get("pairs")
        if not isinstance(radius, (int, float)) or not radius > 0:
            raise DataError(path, "search_radius_m", "metres above 0", radius)
        if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
            raise DataError(path, "pairs", "a list of [query, database] names", type(pairs).__name__)
        return cls(float(radius), tuple(str(q) for q, _ in pairs), tuple(str(d) for _, d in pairs))


class BosonPairs:
    """Pairs of a split for one D_C: each query with a database centre drawn uniformly from those within D_C of it.

    Queries without any are left out. `chosen` replaces the draw. Frames larger than 512 px are cropped about their middle
    and keep the rest as the pair's surround.
    """

    def __init__(
        self,
        queries: ImageFile,
        database: ImageFile,
        satellite: MapImage,
        window_m: int,
        search_radius_m: float,
        seed: Seed = 0,
        name: str = "boson",
        chosen: Chosen | None = None,
    ) -> None:
        for key, value, least in (("window_m", window_m, FRAME_PX), ("search_radius_m", search_radius_m, 1e-9)):
            if value < least:
                raise DataError(name, key, f"at least {least:g}", value)
        if min(queries.size_px) < FRAME_PX:
            raise DataError(queries.path, "image_data", f"at least {FRAME_PX} px a side", queries.size_px)
        self.queries, self.database, self.satellite = queries, database, satellite
        self.window_m, self.search_radius_m, self.seed, self.name = window_m, float(search_radius_m), seed, name
        self._tree = cKDTree(database.positions) if len(database) else None
        self._chosen = self._indices(chosen) if chosen else None
        if self._chosen is not None:
            self._usable = self._chosen[:, 0]
        elif self._tree is None or not len(queries):
            self._usable = np.empty(0, int)
        else:
            distance, _ = self._tree.query(queries.positions)
            self._usable = np.flatnonzero(distance <= search_radius_m)
        if not len(self._usable):
            raise DataError(queries.path, "image_name", f"a query within {search_radius_m:g} px of a database centre", "none")

    def _indices(self, chosen: Chosen) -> NDArray[np.int64]:
        places = []
        for file, names in ((self.queries, chosen.queries), (self.database, chosen.database)):
            known = {name: i for i, name in enumerate(file.names)}
            if unknown := [name for name in names if name not in known]:
                raise DataError(file.path, "image_name", "every name of the stored pairs", f"no {unknown[0]}")
            places.append([known[name] for name in names])
        found = np.array(places).T.reshape(-1, 2)
        distance = np.linalg.norm(self.queries.positions[found[:, 0]] - self.database.positions[found[:, 1]], axis=1)
        if len(found) and distance.max() > self.search_radius_m:
            at = int(distance.argmax())
            radius = f"at most D_C = {self.search_radius_m:g}"
            raise DataError("stored pairs", f"{chosen.queries[at]} {chosen.database[at]}", radius, f"{distance[at]:.1f} px")
        return found

    def __len__(self) -> int:
        return len(self._usable)

    def indices(self, index: int) -> tuple[int, int]:
        """Which query and which database centre."""
        query = int(self._usable[index])
        if self._chosen is not None:
            return query, int(self._chosen[index, 1])
        near = sorted(self._tree.query_ball_point(self.queries.positions[query], self.search_radius_m))
        return query, near[int(np.random.default_rng(words(self.seed, index)).integers(len(near)))]

    def chosen(self) -> Chosen:
        """The pairs as they are drawn, to be stored."""
        drawn = [self.indices(i) for i in range(len(self))]
        queries = tuple(self.queries.names[q] for q, _ in drawn)
        return Chosen(self.search_radius_m, queries, tuple(self.database.names[d] for _, d in drawn))

    def offset_px(self, query: int, database: int) -> NDArray[np.float64]:
        """t: the frame's middle less the window's, x and y. Names are row first, so the published difference is swapped."""
        return (self.queries.positions[query] - np.round(self.database.positions[database]))[::-1]

    def __getitem__(self, index: int) -> Pair:
        if not 0 <= index < len(self):
            raise IndexError(index)
        query, centre = self.indices(index)
        row, column = np.round(self.database.positions[centre]).astype(int)
        whole = self.queries.gray(query)
        thermal = centre_crop(whole, FRAME_PX)
        homography = np.eye(3)
        homography[:2, 2] = self.offset_px(query, centre) + (self.window_m - FRAME_PX) // 2
        return Pair(
            name=self.queries.names[query],
            satellite=self.satellite.crop(int(row), int(column), self.window_m),
            thermal=thermal,
            homography=homography,
            surround=whole if whole.shape[0] == whole.shape[1] > FRAME_PX and whole.shape[0] % 2 == 0 else None,
        )

    def reseeded(self, seed: Seed) -> BosonPairs:
        """Other centres for the same queries; stored pairs stay as they are."""
        other = object.__new__(BosonPairs)
        other.__dict__.update(self.__dict__ | {"seed": seed})
        return other


def centre_crop(image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """`[side, side]` about the middle."""
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    return np.ascontiguousarray(image[top : top + side, left : left + side])


def queries_path(folder: Path, split: str, purpose: Purpose = "evaluate", allow_test_region: bool = False) -> Path:
    """The file of a split's frames; for `extended` the one without the test region."""
    if split not in SPLITS:
        raise DataError(folder, "split", " | ".join(SPLITS), split)
    plain = Path(folder) / f"{split}_queries.h5"
    if split != "extended":
        return plain
    excluded = Path(folder) / "extended_queries_test_excluded.h5"
    if excluded.is_file():
        return excluded
    if purpose == "train" and not allow_test_region:
        raise DataError(
            plain,
            "split",
            f"{excluded.name} beside it: this file holds the test region (allow_test_region = true takes it all the same)",
            "extended_queries.h5 alone" if plain.is_file() else "neither",
        )
    return plain


def open_split(
    folder: Path,
    split: str,
    window_m: int,
    search_radius_m: float,
    seed: Seed = 0,
    satellite: Path | None = None,
    purpose: Purpose = "evaluate",
    allow_test_region: bool = False,
    pairs: Path | None = None,
) -> BosonPairs:
    """A split in its folder. The map: `satellite`, else the published place in the folder or beside it."""
    folder = Path(folder)
    if satellite is None:
        places = [folder / MAP_NAME, folder.parent / MAP_NAME, folder.parent.parent / MAP_NAME]
        satellite = next((path for path in places if path.is_file()), places[0])
    return BosonPairs(
        ImageFile(queries_path(folder, split, purpose, allow_test_region)),
        ImageFile(folder / f"{split}_database.h5", images=False),
        MapImage(satellite),
        window_m,
        search_radius_m,
        seed,
        name=f"{folder.name}/{split}",
        chosen=Chosen.load(pairs) if pairs else None,
    )


def names_of(positions: list[tuple[float, float]]) -> list[str]:
    """Rows and columns -> `image_name`, with 1e-5 more in the column for each further image at one place."""
    seen: dict[tuple[float, float], int] = {}
    names = []
    for row, column in positions:
        times = seen.get((row, column), 0)
        seen[row, column] = times + 1
        second = f"{column:.10g}" if times == 0 else f"{column + times * DUPLICATE_STEP:.5f}"
        names.append(f"@{row:.10g}@{second}")
    return names


def write(path: Path, images: Iterable[NDArray[np.uint8]], positions: list[tuple[float, float]]) -> None:
    """A file in exactly the published layout: images u8 `[H, W, 3]` or `[H, W]`, all of one size, one by one, and their
    rows and columns."""
    with h5py.File(path, "w") as file:
        data = None
        for i, image in enumerate(images):
            rgb = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
            if data is None:
                shape = (len(positions), *rgb.shape)
                data = file.create_dataset("image_data", shape, np.uint8, chunks=(1, *rgb.shape), compression="lzf")
            data[i] = rgb
        if data is None or i + 1 != len(positions):
            raise DataError(path, "image_data", f"{len(positions)} images, at least one", 0 if data is None else i + 1)
        file.create_dataset("image_size", data=np.tile(rgb.shape[:2], (len(positions), 1)))
        file.create_dataset("image_name", data=names_of(positions), dtype=h5py.string_dtype("utf-8"))
