"""Do coarse map features belong to the map, not to the window? A crop of the whole map's features beside the crop's own.

    python -m sthn.evaluate.features --bundle models/bundles/lite-1536 --maps MAP ... [--report FILE.md]

The bundle's map encoder (`coarse_map.onnx`, which takes any multiple of its strides) sees a whole map at the stage's metres
per pixel, and squares cut from it. Feature cells have unit length; for each rim, in cells from a square's edge, the largest
difference of any channel inside it is given, over all squares of all maps. What is left at a rim comes from the zeros that
convolutions see beyond a square's edge: with statistics over the window it would not fall with the rim at all.

Squares begin at multiples of the encoder's total stride (16 px): between them, strided convolutions sample other places.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .. import correlate
from ..bundle import Bundle, BundleError, read_bundle
from ..lite.scene import read_rgb

TOTAL_STRIDE_PX = 16
CROP_PX = 256
TOLERANCE = 1e-3
RIMS = (0, 1, 2, 4, 8, 12, 16, 20, 24, 28, 32, 40, 48)


def encode(bundle: Bundle, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """`[h, w, 3]` in 0..1 -> `[C, h / stride, w / stride]`."""
    return bundle.run("coarse_map", map=np.moveaxis(image, -1, 0)[None])["map_features"][0]


def at_stage_scale(bundle: Bundle, rgb: NDArray[np.uint8], m_per_px: float) -> NDArray[np.float32]:
    """A map -> the largest square of it at the coarse stage's metres per pixel, a multiple of the strides, 0..1."""
    spec = bundle.manifest["coarse"]["map"]
    step = spec["width_m"] / spec["size_px"]
    side = int(min(rgb.shape[:2]) * m_per_px / step) // TOTAL_STRIDE_PX * TOTAL_STRIDE_PX
    used = round(side * step / m_per_px)
    return correlate.resize(rgb[:used, :used].astype(np.float32) / 255.0, side)


def differences(bundle: Bundle, image: NDArray[np.float32], crop_px: int = CROP_PX) -> NDArray[np.float64]:
    """`[crop_px / stride / 2]`: largest difference of any cell at exactly this distance from a square's edge."""
    if bundle.manifest["coarse"]["kind"] != "correlation":
        raise BundleError(f"coarse.kind: expected correlation, found {bundle.manifest['coarse']['kind']}")
    stride = bundle.manifest["coarse"]["stride"]
    side = min(image.shape[:2])
    if side <= crop_px:
        raise BundleError(f"map: expected more than {crop_px} px at the stage's scale, found {side}")
    whole = encode(bundle, image)
    cells = crop_px // stride
    index = np.arange(cells)
    edge = np.minimum(index, cells - 1 - index)
    distance = np.minimum(edge[:, None], edge[None, :])
    most = np.zeros(cells // 2)
    # Squares that do not touch the map's own edge, where the whole map sees zeros too.
    starts = sorted({TOTAL_STRIDE_PX, (side - crop_px) // 2 // TOTAL_STRIDE_PX * TOTAL_STRIDE_PX, side - crop_px})
    for y in starts:
        for x in starts:
            own = encode(bundle, image[y : y + crop_px, x : x + crop_px])
            part = whole[:, y // stride : y // stride + cells, x // stride : x // stride + cells]
            away = np.abs(own.astype(np.float64) - part).max(0)
            most = np.maximum(most, [away[distance == d].max() for d in range(cells // 2)])
    return most


def inside(at: NDArray[np.float64], rim: int) -> float:
    """Largest difference at `rim` cells from the edge and further in."""
    return float(at[rim:].max())


def rim_within(at: NDArray[np.float64], tolerance: float = TOLERANCE) -> int | None:
    """The least rim, in cells, inside which every difference is within the tolerance."""
    return next((rim for rim in range(len(at)) if inside(at, rim) <= tolerance), None)


def main(arguments: list[str] | None = None) -> int:
    """The command: 0 where a rim exists, 1 where none does."""
    words = sys.argv[1:] if arguments is None else arguments
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m sthn.evaluate.features", description=__doc__, formatter_class=raw)
    parser.add_argument("--bundle", type=Path, default=Path("models/bundles/lite-1536"))
    parser.add_argument("--maps", type=Path, nargs="*", default=[], help="none: the map of the bundle's golden pair")
    parser.add_argument("--report", type=Path, help="Markdown")
    o = parser.parse_args(words)
    try:
        bundle = read_bundle(o.bundle)
        assert bundle.golden is not None
        maps = {p.stem: read_rgb(p) for p in o.maps} or {"golden pair": (bundle.golden["map_rgb"], 1.0)}
        images = {name: at_stage_scale(bundle, *found) for name, found in maps.items()}
        at = np.max([differences(bundle, image) for image in images.values()], axis=0)
    except (ValueError, OSError) as error:
        print(f"features: {error}", file=sys.stderr)
        return 2
    rim, spec = rim_within(at), bundle.manifest["coarse"]
    cell_m = spec["stride"] * spec["map"]["width_m"] / spec["map"]["size_px"]
    lines = [
        f"`python -m sthn.evaluate.features {shlex.join(words)}`",
        "",
        "| rim, cells | rim, m | largest difference |",
        "|---|---|---|",
    ]
    lines += [f"| {r} | {r * cell_m:.0f} | {inside(at, r):.1e} |" for r in RIMS if r < len(at)]
    said = f"From a rim of {rim} cells ({rim * cell_m:.0f} m) on" if rim is not None else "At no rim"
    sizes = ", ".join(f"{name} ({image.shape[1]} px)" for name, image in images.items())
    lines += ["", f"{said} every difference is within {TOLERANCE:g}. Squares of {CROP_PX} px in: {sizes}."]
    print("\n".join(lines))
    if o.report:
        o.report.parent.mkdir(parents=True, exist_ok=True)
        what = (__doc__ or "").split("\n\n")
        title = f"# Map features of {bundle.manifest['name']} belong to the map"
        o.report.write_text("\n".join([title, "", what[2], "", what[3].strip(), "", *lines]) + "\n")
    return 0 if rim is not None else 1


if __name__ == "__main__":
    sys.exit(main())
