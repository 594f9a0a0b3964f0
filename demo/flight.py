"""A recorded flight, read: `flight.toml` and `poses.csv` (see "Recorded flight" in ARCHITECTURE.md)."""

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

ENCODINGS = {".png": "png", ".tif": "tiff", ".tiff": "tiff", ".jpg": "jpeg", ".jpeg": "jpeg"}
POSE_COLUMNS = ("agl_m", "gsd_m", "yaw_deg", "pitch_deg", "roll_deg")


@dataclass(frozen=True)
class Row:
    """One frame: its file and the row's numbers, those that are known."""

    path: Path
    stamp_ns: int
    values: dict[str, float]

    @property
    def truth(self) -> tuple[float, float] | None:
        """True latitude and longitude, WGS84 degrees."""
        pair = self.values.get("truth_lat_deg"), self.values.get("truth_lon_deg")
        return None if None in pair else pair

    def attachment(self, hfov_deg: float | None) -> dict:
        """What travels beside the frame's bytes. Never the truth."""
        with Image.open(self.path) as image:
            width, height = image.size
        message = {
            "stamp_ns": self.stamp_ns,
            "encoding": ENCODINGS[self.path.suffix.lower()],
            "width": width,
            "height": height,
        }
        message |= {name: self.values[name] for name in POSE_COLUMNS if name in self.values}
        if hfov_deg is not None:
            message["hfov_deg"] = hfov_deg
        return message

    def prior(self) -> dict | None:
        """The row's prior as a message, where it has one."""
        if "prior_lat_deg" not in self.values:
            return None
        message = {
            "stamp_ns": self.stamp_ns,
            "lat_deg": self.values["prior_lat_deg"],
            "lon_deg": self.values["prior_lon_deg"],
        }
        spread = "radius_m" if "prior_radius_m" in self.values else "sigma_m"
        return message | {spread: self.values[f"prior_{spread}"]}


@dataclass(frozen=True)
class Flight:
    """A flight's folder, read."""

    map_path: Path
    hfov_deg: float | None
    rows: list[Row]


def read_flight(folder: Path) -> Flight:
    """Reads the folder; an empty cell is unknown, never 0."""
    with open(folder / "flight.toml", "rb") as file:
        header = tomllib.load(file)
    rows = []
    with open(folder / "poses.csv", newline="") as file:
        for cells in csv.DictReader(file):
            name, stamp_ns = cells.pop("file"), int(cells.pop("stamp_ns"))
            rows.append(Row(folder / name, stamp_ns, {key: float(cell) for key, cell in cells.items() if cell}))
    return Flight(folder / header["map"], header.get("camera", {}).get("hfov_deg"), rows)
