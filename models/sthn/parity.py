"""`python -m sthn.parity DIR`: does our network reproduce the numbers of the published code?

DIR holds `config.json`, `model.safetensors`, `satellite.png`, `thermal.png` and `expected.npz`. A `procedural_1536.npz`
(or a folder with nothing but it) is the case whose weights and images are made by formula. Every array's largest
difference is printed; above its tolerance the exit code is 1.

Every stage answers for itself: where a case stores a stage's inputs, the stage is fed those. `end_to_end` is the final
displacement from the images alone. Its tolerance is wider, because rounding (another number of threads is enough) moves
the coarse displacement by 3e-5 px, and on a noisy image the fine stage answers 2e-4 px of crop with 2e-3 px.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from . import procedural
from .checkpoint import load_checkpoint
from .network import Match, Sthn, bounding_box, combine, crop

TOLERANCES = {
    "satellite_256": 1e-5,
    "thermal_256": 1e-5,
    # Sums of 196 608 numbers in 32 bits: 2e-6 of their size.
    "satellite_256_sum": 0.2,
    "thermal_256_sum": 0.2,
    "feature_satellite": 1e-4,
    "coarse_iterations": 1e-3,
    "crop_256": 1e-3,
    "flow_bbox": 1e-3,
    "fine_iterations": 1e-3,
    "final": 1e-3,
    "end_to_end": 1e-2,
}
"""Largest difference of each array: 0..1 values, features, or pixels."""

FEATURE_STEP = 16
"""Every 16th channel of the coarse encoder is stored."""


class ParityError(ValueError):
    """A case that cannot be compared. The text names the array."""


def to_tensor(pixels: NDArray[np.uint8]) -> Tensor:
    """`[H, W]` or `[H, W, 3]` u8 -> `[1, 3, H, W]` in 0..1; gray is taken three times."""
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    return torch.from_numpy(pixels.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255))


def arrays(network: Sthn, window: Tensor, frame: Tensor, stored: Mapping[str, NDArray[np.float32]]) -> dict[str, Tensor]:
    """Everything that a case may hold, by its stored name; stages fed from `stored` where it has their inputs."""
    config = network.config
    match: Match = network(window, frame)
    out = {
        "satellite_256": match.satellite,
        "thermal_256": match.thermal,
        "satellite_256_sum": match.satellite.double().sum(),
        "thermal_256_sum": match.thermal.double().sum(),
        "feature_satellite": network.netG.encode(match.satellite)[:, ::FEATURE_STEP],
        "coarse_iterations": match.coarse_iterations,
        "final": match.final,
        "end_to_end": match.final,
    }
    if network.netG_fine is not None:
        box = bounding_box(torch.from_numpy(stored["coarse_iterations"][-1]), config)
        cut = crop(window, box, config.resize_width)
        fed = torch.from_numpy(stored["crop_256"]) if "crop_256" in stored else cut
        fine = network.netG_fine(fed, match.thermal)
        out |= {
            "flow_bbox": box.flow(config.database_size),
            "crop_256": cut,
            "fine_iterations": fine,
            "final": combine(fine[-1], box, config),
        }
    return out


def differences(network: Sthn, window: NDArray[np.uint8], frame: NDArray[np.uint8], expected: Path) -> dict[str, float]:
    """Runs the network and returns the largest absolute difference of every array in `expected`."""
    with np.load(expected, allow_pickle=False) as archive:
        stored = {name: archive[name] for name in archive.files}
    needed = ["coarse_iterations", "final"] + (["flow_bbox", "fine_iterations"] if network.config.two_stages else [])
    if missing := [name for name in needed if name not in stored]:
        raise ParityError(f"{expected}: missing {', '.join(missing)}")
    with torch.inference_mode():
        found = arrays(network, to_tensor(window), to_tensor(frame), stored)
    out = {}
    for name, value in (stored | {"end_to_end": stored["final"]}).items():
        if name not in found:
            raise ParityError(f"{expected}: {name}: nothing to compare it with")
        if value.shape != tuple(found[name].shape):
            raise ParityError(f"{expected}: {name}: expected shape {value.shape}, found {tuple(found[name].shape)}")
        out[name] = float(np.abs(value.astype(np.float64) - found[name].double().numpy()).max())
    return out


def check(path: Path) -> dict[str, float]:
    """The differences of one case: a directory, or the procedural `.npz`."""
    if path.is_file():
        return differences(procedural.network(procedural.PARITY_1536), procedural.image(1536), procedural.thermal(), path)
    network = load_checkpoint(path)
    window, frame = (np.asarray(Image.open(path / name)) for name in ("satellite.png", "thermal.png"))
    side = network.config.database_size
    if window.shape != (side, side, 3):
        raise ParityError(f"{path / 'satellite.png'}: expected {side} x {side} RGB, found {window.shape}")
    return differences(network, window, frame, path / "expected.npz")


def cases(path: Path) -> Iterator[Path]:
    """The case at `path`, or every case in the folder `path`."""
    if path.is_file() or (path / "config.json").is_file():
        yield path
    elif path.is_dir():
        yield from sorted(
            inner for inner in path.iterdir() if (inner / "config.json").is_file() or inner.match("procedural_*.npz")
        )


def report(path: Path, found: dict[str, float]) -> bool:
    """Prints one case; whether it is within every tolerance."""
    print(path)
    good = True
    for name, value in found.items():
        within = value <= TOLERANCES[name]  # false for NaN
        good &= within
        print(f"  {name:20} {value:10.3g}  tolerance {TOLERANCES[name]:g}  {'ok' if within else 'FAILED'}")
    return good


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m sthn.parity", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("path", type=Path, help="a case, or a folder of cases")
    path = parser.parse_args(arguments).path
    found = list(cases(path))
    if not found:
        print(f"{path}: no case: expected config.json or an .npz", file=sys.stderr)
        return 1
    good = True
    for case in found:
        try:
            good &= report(case, check(case))
        except (ValueError, OSError, RuntimeError) as error:
            print(f"{case}: {error}", file=sys.stderr)
            good = False
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
