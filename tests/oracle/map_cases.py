"""GeoTIFFs of many kinds, and windows of them resampled by pyproj and NumPy.

Usage: map_cases.py OUT_DIR GROUP. Writes the files and `cases.tsv`: name, file, lat, lon, width_m, m_per_px, size_px. Beside each
case stand `NAME.rgb` (f32) and `NAME.valid` (u8). Every window pixel goes the whole way by itself: geodesic, projection, inverse
affine, bilinear in float64. Nothing is shared with the code under test.
"""

import sys
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from rasterio.enums import ColorInterp, Resampling
from rasterio.transform import Affine
from rasterio.windows import Window

GEOD = pyproj.Geod(ellps="WGS84")


def picture(width, height, bands, seed=1, smooth=6.0):
    """A smooth coloured texture with a little noise, u8, [bands, height, width]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    out = []
    for _ in range(bands):
        band = np.full((height, width), 128.0)
        for _ in range(6):
            fx, fy = rng.normal(0, 1 / (smooth * 4), 2)
            band += 28 * np.sin(2 * np.pi * (fx * x + fy * y) + rng.uniform(0, 6))
        out.append(band + rng.normal(0, 4, band.shape))
    return np.clip(np.round(out), 1, 254).astype(np.uint8)


def bilinear(image, valid, xs, ys):
    """Samples [bands, h, w] at pixel centres-are-integers coordinates; invalid unless all weighted neighbours are valid."""
    bands, height, width = image.shape
    # The resolution of the weights under test: a neighbour that weighs less than that does not count.
    xs, ys = np.round(xs * 256) / 256, np.round(ys * 256) / 256
    x0, y0 = np.floor(xs).astype(int), np.floor(ys).astype(int)
    u, v = xs - x0, ys - y0
    total = np.zeros((bands, *xs.shape))
    good = np.ones(xs.shape, bool)
    for dx, dy, weight in ((0, 0, (1 - u) * (1 - v)), (1, 0, u * (1 - v)), (0, 1, (1 - u) * v), (1, 1, u * v)):
        x, y = x0 + dx, y0 + dy
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        xi, yi = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
        total += image[:, yi, xi] * weight
        good &= (inside & valid[yi, xi]) | (weight < 0.5 / 256)
    return total, good


def window(dataset, rgb, valid, lat, lon, size, m_per_px, samples=1):
    """The window: [size, size, 3] and validity; `samples` x `samples` points are averaged per pixel."""
    to_crs = pyproj.Transformer.from_crs(4326, dataset.crs, always_xy=True)
    inverse = ~dataset.transform
    total, good = 0, True
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    for dy in steps:
        for dx in steps:
            y, x = np.mgrid[0:size, 0:size].astype(np.float64)
            east, north = (x + dx - (size - 1) / 2) * m_per_px, ((size - 1) / 2 - y - dy) * m_per_px
            azimuth = np.degrees(np.arctan2(east, north))
            lons, lats, _ = GEOD.fwd(np.full(x.shape, lon), np.full(x.shape, lat), azimuth, np.hypot(east, north))
            if dataset.crs.is_geographic or dataset.crs.to_epsg() == 3857:
                middle = dataset.transform * (dataset.width / 2, dataset.height / 2)
                turn = 360.0 if dataset.crs.is_geographic else 2 * np.pi * 6378137
                cx, cy = to_crs.transform(lons, lats)
                cx = cx + np.round((middle[0] - cx) / turn) * turn
            else:
                cx, cy = to_crs.transform(lons, lats)
            col, row = inverse * (cx, cy)
            value, ok = bilinear(rgb.astype(np.float64), valid, col - 0.5, row - 0.5)
            total, good = total + value, good & ok
    return np.moveaxis(total / samples**2, 0, -1).astype(np.float32), good


class Cases:
    def __init__(self, out):
        self.out, self.lines = Path(out), []

    def add(self, name, file, size=180, m_per_px=1.0, east=13.3, north=-7.7, rgb=None, valid=None, samples=1, at=None):
        """One window of `file`, its middle `east`/`north` metres off the map's; pixels and validity from GDAL unless given."""
        with rasterio.open(file) as d:
            if at is None:
                cx, cy = d.transform * (d.width / 2, d.height / 2)
                lon, lat = pyproj.Transformer.from_crs(d.crs, 4326, always_xy=True).transform(cx, cy)
                lon, lat, _ = GEOD.fwd(lon, lat, np.degrees(np.arctan2(east, north)), np.hypot(east, north))
            else:
                lat, lon = at
            if rgb is None:
                rgb = d.read([1, 2, 3]) if d.count >= 3 else np.repeat(d.read([1]), 3, axis=0)
            if valid is None:
                valid = d.dataset_mask() > 127
            pixels, good = window(d, rgb, valid, lat, lon, size, m_per_px, samples)
        pixels.tofile(self.out / f"{name}.rgb")
        good.astype(np.uint8).tofile(self.out / f"{name}.valid")
        self.lines.append(
            "\t".join(map(str, (name, Path(file).name, repr(float(lat)), repr(float(lon)), size * m_per_px, m_per_px, size)))
        )

    def close(self):
        (self.out / "cases.tsv").write_text("\n".join(self.lines) + "\n")


UTM = {"crs": "EPSG:32640", "transform": Affine(1, 0, 344000.25, 0, -1, 2790000.75)}


def write(path, image, **options):
    """A GeoTIFF of `image` [bands, h, w]."""
    profile = dict(driver="GTiff", count=image.shape[0], height=image.shape[1], width=image.shape[2], dtype=image.dtype, **UTM)
    tags, masks, interp, overviews = (options.pop(k, None) for k in ("tags", "mask", "interp", "overviews"))
    environment = options.pop("env", {})
    profile.update(options)
    with rasterio.Env(**environment), rasterio.open(path, "w", **profile) as d:
        if tags:
            d.update_tags(**tags)
        if interp:
            d.colorinterp = interp
        d.write(image)
        if masks is not None:
            d.write_mask(masks)
    if overviews:
        with rasterio.open(path, "r+") as d:
            d.build_overviews(overviews, Resampling.average)
    return path


def packings(c):
    """Every compression, tiled and striped, with and without predictor, chunky and planar."""
    image = picture(300, 280, 3)
    tiled = {"tiled": True, "blockxsize": 64, "blockysize": 48}
    for name, options in {
        "none": {},
        "deflate": {"compress": "deflate"},
        "deflate_pred": {"compress": "deflate", "predictor": 2},
        "lzw": {"compress": "lzw"},
        "lzw_pred": {"compress": "lzw", "predictor": 2},
        "zstd": {"compress": "zstd"},
        "zstd_pred": {"compress": "zstd", "predictor": 2},
        "packbits": {"compress": "packbits"},
        "webp": {"compress": "webp", "WEBP_LOSSLESS": True},
    }.items():
        c.add(f"tiled_{name}", write(c.out / f"tiled_{name}.tif", image, **tiled, **options))
        c.add(f"strips_{name}", write(c.out / f"strips_{name}.tif", image, blockysize=11, tiled=False, **options))
        if name != "webp":
            c.add(f"planar_{name}", write(c.out / f"planar_{name}.tif", image, interleave="band", **tiled, **options))
            big = {"BIGTIFF": "YES", "ENDIANNESS": "BIG"}
            c.add(f"big_{name}", write(c.out / f"big_{name}.tif", image, **tiled, **options, **big))
    c.add("planar_strips", write(c.out / "planar_strips.tif", image, interleave="band", compress="lzw", predictor=2))
    c.add("one_strip", write(c.out / "one_strip.tif", image, blockysize=280, tiled=False))


def jpegs(c):
    """Lossy: compared with GDAL's decoding."""
    image = picture(300, 280, 3, smooth=20)
    tiled = {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "jpeg", "JPEG_QUALITY": 95}
    c.add("jpeg_ycbcr", write(c.out / "jpeg_ycbcr.tif", image, photometric="ycbcr", **tiled))
    c.add("jpeg_rgb", write(c.out / "jpeg_rgb.tif", image, photometric="rgb", **tiled))
    c.add("jpeg_grey", write(c.out / "jpeg_grey.tif", image[:1], **tiled))
    c.add("jpeg_planar", write(c.out / "jpeg_planar.tif", image, interleave="band", photometric="rgb", **tiled))
    strips = {"compress": "jpeg", "JPEG_QUALITY": 95, "blockysize": 16, "tiled": False}
    c.add("jpeg_strips", write(c.out / "jpeg_strips.tif", image, photometric="ycbcr", **strips))
    alpha = np.full((1, *image.shape[1:]), 255, np.uint8)
    c.add("jpeg_rgba", write(c.out / "jpeg_rgba.tif", np.concatenate([image, alpha]), photometric="rgb", **tiled))
    mask = np.full(image.shape[1:], 255, np.uint8)
    mask[100:140, 120:200] = 0
    env = {"GDAL_TIFF_INTERNAL_MASK": True}
    c.add("jpeg_mask", write(c.out / "jpeg_mask.tif", image, photometric="ycbcr", mask=mask, env=env, **tiled))


def validity(c):
    """Nodata, alpha, masks, sparse tiles, windows that hang off the map."""
    tiled = {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate"}
    image = picture(300, 280, 3)
    hole = image.copy()
    hole[:, 90:150, 100:170] = 0
    hole[0, 170:180, 100:170] = 0  # one band alone is a colour, not nodata
    c.add("nodata", write(c.out / "nodata.tif", hole, nodata=0, **tiled))
    alpha = np.full((1, *image.shape[1:]), 255, np.uint8)
    alpha[:, 90:150, 100:170] = 0
    rgba = np.concatenate([image, alpha])
    colours = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    c.add("alpha", write(c.out / "alpha.tif", rgba, interp=[*colours, ColorInterp.alpha], **tiled))
    c.add(
        "alpha_planar", write(c.out / "alpha_planar.tif", rgba, interp=[*colours, ColorInterp.alpha], interleave="band", **tiled)
    )
    everywhere = np.ones(image.shape[1:], bool)
    for predictor in (1, 2):
        file = write(c.out / f"nir_{predictor}.tif", rgba, photometric="rgb", ALPHA="NO", predictor=predictor, **tiled)
        c.add(f"nir_{predictor}", file, valid=everywhere)
    five = np.concatenate([image, picture(300, 280, 1, seed=5), alpha])
    interp = [*colours, ColorInterp.undefined, ColorInterp.alpha]
    # GDAL's dataset mask knows alpha only as the second or the fourth band.
    file = write(c.out / "nir_alpha.tif", five, photometric="rgb", ALPHA="NO", interp=interp, **tiled)
    c.add("nir_alpha", file, valid=alpha[0] > 127)
    c.add("grey", write(c.out / "grey.tif", image[:1], **tiled))
    grey_alpha = np.concatenate([image[:1], alpha])
    c.add("grey_alpha", write(c.out / "grey_alpha.tif", grey_alpha, interp=[ColorInterp.gray, ColorInterp.alpha], **tiled))
    file = c.out / "inverted.tif"
    c.add("inverted", write(file, image[:1], photometric="miniswhite", **tiled), rgb=np.repeat(255 - image[:1], 3, axis=0))
    mask = np.full(image.shape[1:], 255, np.uint8)
    mask[90:150, 100:170] = 0
    env = {"GDAL_TIFF_INTERNAL_MASK": True}
    c.add("mask", write(c.out / "mask.tif", image, mask=mask, env=env, **tiled))
    strips = {"compress": "lzw", "blockysize": 7, "tiled": False}
    c.add("mask_strips", write(c.out / "mask_strips.tif", image, mask=mask, env=env, **strips))
    profile = dict(driver="GTiff", count=3, height=280, width=300, dtype="uint8", SPARSE_OK=True, **UTM, **tiled)
    with rasterio.open(c.out / "sparse.tif", "w", **profile) as d:
        d.write(image[:, :128, :192], window=Window(0, 0, 192, 128))
    written = np.zeros(image.shape[1:], bool)
    written[:128, :192] = True
    c.add("sparse", c.out / "sparse.tif", valid=written)
    plain = write(c.out / "plain.tif", image, **tiled)
    c.add("off_right", plain, east=120, north=15)
    c.add("off_corner", plain, east=-171.4, north=160.2)
    c.add("off_all", plain, east=5000, north=0)
    palette = write(c.out / "palette.tif", (image[:1] // 64), photometric="palette", **tiled)
    table = {0: (10, 20, 30), 1: (250, 0, 9), 2: (90, 91, 92), 3: (0, 255, 128)}
    with rasterio.open(palette, "r+") as d:
        d.write_colormap(1, table)
    colours = np.array([table[i] for i in range(4)], np.uint8)
    c.add("palette", palette, rgb=np.moveaxis(colours[image[0] // 64], -1, 0))


def depths(c):
    """16 bits: the documented rule, written again."""
    image = picture(300, 280, 3)
    tiled = {"tiled": True, "blockxsize": 128, "blockysize": 128}
    noise = np.random.default_rng(3).integers(0, 256, image.shape)
    full = image.astype(np.uint16) * 256 + noise.astype(np.uint16)
    twelve = (image.astype(np.uint16) << 4) + (noise >> 4).astype(np.uint16)
    white = np.sort(twelve.ravel())[int(np.ceil(twelve.size * 0.995)) - 1]
    stretched = np.minimum((twelve.astype(np.int64) * 255 + white // 2) // white, 255).astype(np.uint8)
    for name, options in {
        "deflate": {"compress": "deflate"},
        "lzw_pred": {"compress": "lzw", "predictor": 2},
        "zstd_pred_planar": {"compress": "zstd", "predictor": 2, "interleave": "band"},
        "big_endian": {"compress": "deflate", "predictor": 2, "ENDIANNESS": "BIG"},
        "rgb": {"compress": "deflate", "photometric": "rgb"},
    }.items():
        c.add(f"full_{name}", write(c.out / f"full_{name}.tif", full, **tiled, **options), rgb=(full >> 8).astype(np.uint8))
        c.add(f"twelve_{name}", write(c.out / f"twelve_{name}.tif", twelve, **tiled, **options), rgb=stretched)


def places(c):
    """Systems, pixel-is-point, rotation, the antimeridian."""
    tiled = {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate"}
    image = picture(400, 380, 3)
    for name, crs, transform in [
        ("utm_north", 32640, Affine(1, 0, 344000.3, 0, -1, 2790000.6)),
        ("utm_south", 32756, Affine(0.8, 0, 334000.0, 0, -0.9, 6252000.0)),
        ("utm_edge_60n", 32633, Affine(1, 0, 665000.0, 0, -1, 6660000.0)),
        ("mercator", 3857, Affine(1.2, 0, -13610655.6, 0, -1.2, 4561810.7)),
        ("mercator_60n", 3857, Affine(2, 0, 2700000.0, 0, -2, 8400000.0)),
        ("degrees", 4326, Affine(1e-5, 0, 55.45, 0, -9e-6, 25.21)),
        ("degrees_60n", 4326, Affine(1.8e-5, 0, 24.9, 0, -9e-6, 60.2)),
        ("lambert93", 2154, Affine(1, 0, 652000.0, 0, -1, 6862000.0)),
        ("laea_europe", 3035, Affine(1, 0, 4321000.0 + 400000, 0, -1, 3210000.0)),
        ("polar_north", 3413, Affine(1, 0, 300000.0, 0, -1, -900000.0)),
        ("polar_south", 3031, Affine(1, 0, -300000.0, 0, -1, 1300000.0)),
        ("feet", 2263, Affine(3.3, 0, 985000.0, 0, -3.3, 205000.0)),
        ("rotated", 32640, Affine(0.9, 0.35, 344000.0, 0.35, -0.9, 2790000.0)),
        ("upside_down", 32640, Affine(1, 0, 344000.0, 0, 1, 2790000.0)),
        ("antimeridian", 4326, Affine(1e-5, 0, 179.998, 0, -9e-6, -16.5)),
    ]:
        c.add(name, write(c.out / f"{name}.tif", image, crs=f"EPSG:{crs}", transform=transform, **tiled), size=150)
    point = write(c.out / "point.tif", image, tags={"AREA_OR_POINT": "Point"}, **tiled)
    c.add("point", point)
    # Two windows on either side of the 180th meridian.
    c.add("antimeridian_east", c.out / "antimeridian.tif", at=(-16.5015, -179.9995), size=100)
    c.add("antimeridian_west", c.out / "antimeridian.tif", at=(-16.5015, 179.9995), size=100)


def scales(c):
    """Coarser and finer windows than the map: upsampling, boxes, two samples, overviews."""
    tiled = {"tiled": True, "blockxsize": 128, "blockysize": 128, "compress": "deflate"}
    image = picture(1500, 1400, 3, smooth=8)
    file = write(c.out / "fine.tif", image, **tiled)
    for m_per_px in (0.4, 1.0, 1.2):
        c.add(f"plain_{m_per_px}", file, m_per_px=m_per_px)
    for m_per_px in (1.6, 2.0, 2.7, 5.0, 6.0):
        c.add(f"area_{m_per_px}", file, m_per_px=m_per_px, size=90, samples=4)
    turned = write(c.out / "turned.tif", image, transform=Affine(0.6, 0.8, 344000.0, 0.8, -0.6, 2790000.0), **tiled)
    c.add("area_turned", turned, m_per_px=3.6, size=90, samples=4)
    overviews = write(c.out / "overviews.tif", image, overviews=[2, 4, 8], **tiled)
    for m_per_px in (2.0, 6.0, 9.0):
        c.add(f"area_overview_{m_per_px}", overviews, m_per_px=m_per_px, size=90, samples=4)


if __name__ == "__main__":
    cases = Cases(sys.argv[1])
    globals()[sys.argv[2]](cases)
    cases.close()
