"""`python -m sthn.convert CHECKPOINT --out BUNDLE`: a released STHN checkpoint -> a bundle that nightfix runs.

    python -m sthn.convert STHN-two-stages --out bundles/sthn-1536                  folder: config.json, model.safetensors
    python -m sthn.convert STHN.pth --window 1536 --levels 4 --out bundles/sthn-1536    netG, netG_fine, `module.` or not
    python -m sthn.convert STHN-512.pth --window 512 --levels 2 --search-radius-m 64 --out bundles/sthn-512
    nightfix check --config CONFIG                                                  with `bundle = "bundles/sthn-1536"`

The published architecture at full size through the one door (`sthn.export`, `sthn.bundle`): graphs are checked against
PyTorch to 1e-3 px and the whole localisation end to end, or nothing is written. What differs from `sthn.export`: the name
is the bundle's folder, the padding is the paper's evaluation value of 32 m (a released config may say 0, which the public
scripts override), and a stored parity case beside the checkpoint (`satellite.png`, `thermal.png`, `expected.npz`) is run
through the written bundle. The coarse stage's correlation levels stand in no `.pth`: 2 for W_S = 512, 4 for 1024, 1536.

Licences: the hub's tag of the released weights is MIT, the text of the data's gate is for non-commercial research. Read
both, and say with --licence what holds for you.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from . import export, pipeline
from .bundle import BundleError, read_bundle

PAPER_PADDING = 32
"""Window px on each side of the coarse box, in the paper's evaluation."""

PARITY_TOLERANCE_PX = 1e-2
"""Final displacement from the images alone, as `sthn.parity`'s `end_to_end`."""


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m sthn.convert", description=__doc__, formatter_class=raw)
    parser.add_argument("checkpoint", type=Path, help="folder with config.json and model.safetensors, or a .pth")
    parser.add_argument("--out", type=Path, required=True, help="the bundle's folder")
    parser.add_argument("--name", help="the bundle's name, in every fix message (default: that of its folder)")
    parser.add_argument("--padding", type=int, help=f"m on each side of the coarse box (default: {PAPER_PADDING})")
    options, more = parser.parse_known_args(arguments)
    if not options.checkpoint.exists():
        print(f"convert: {options.checkpoint}: expected a folder or a .pth file, found nothing", file=sys.stderr)
        return 1
    padding = PAPER_PADDING if options.padding is None else options.padding
    words = [str(options.checkpoint), "--out", str(options.out), "--name", options.name or options.out.name]
    # Further words are the export's: --window, --levels, --lookup, --fine, --one-stage, --search-radius-m, --licence, ...
    if code := export.main([*words, "--padding", str(padding), *more]):
        return code
    if (options.checkpoint / "expected.npz").is_file():
        try:
            difference = compare(options.out, options.checkpoint, padding)
        except (ValueError, OSError) as error:
            print(f"convert: {error}", file=sys.stderr)
            return 1
        print(f"  {'stored parity case: final':28} {difference:10.3g}")
    print(f"{options.out}: converted. Next: nightfix check, with this folder as its bundle")
    return 0


def compare(folder: Path, case: Path, padding: int) -> float:
    """Largest difference of the bundle's final displacement from the stored one, pixels; [`BundleError`] above tolerance."""
    window, frame = (np.asarray(Image.open(case / name)) for name in ("satellite.png", "thermal.png"))
    with np.load(case / "expected.npz", allow_pickle=False) as archive:
        expected = archive["final"][0]
    gray = frame if frame.ndim == 2 else frame[..., 0]
    difference = float(np.abs(pipeline.match_pair(read_bundle(folder), window, gray).final - expected).max())
    if not difference <= PARITY_TOLERANCE_PX:
        raise BundleError(
            f"{case / 'expected.npz'}: final: expected {PARITY_TOLERANCE_PX} px at most from the stored numbers, found "
            f"{difference:.3g} (padding {padding})"
        )
    return difference


if __name__ == "__main__":
    sys.exit(main())
