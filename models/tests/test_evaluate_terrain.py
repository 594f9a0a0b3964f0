"""Kinds of ground, farmland's columns, and whose the map features are."""

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from conftest import ROOT

from sthn.bundle import read_bundle
from sthn.evaluate import features, terrain
from sthn.evaluate.terrain import BARE, BUILDING, WATER, Frame, LandCover, kind_of

NIGHTFIX = ROOT / "target" / "release" / "nightfix"


@pytest.mark.parametrize(
    ("shares", "kind"),
    [
        ({WATER: 0.61}, "water over 60 %"),
        ({WATER: 0.2, BARE: 0.8}, "water 20 to 60 %"),
        ({BARE: 0.81, BUILDING: 0.19}, "desert"),
        ({BARE: 0.7, BUILDING: 0.16}, "dense suburb"),
        ({BARE: 0.8, BUILDING: 0.1}, "mixed"),
        ({}, "mixed"),
    ],
)
def test_a_kind_of_ground_is_that_of_its_shares(shares: dict[int, float], kind: str) -> None:
    assert kind_of(shares) == kind


def raster(path: Path, pixels: np.ndarray, step: float = 1.0) -> Path:
    transform = rasterio.transform.from_origin(500000, 2800000, step, step)
    with rasterio.open(
        path, "w", driver="GTiff", width=pixels.shape[-1], height=pixels.shape[-2], count=len(pixels), dtype="uint8",
        crs="EPSG:32640", transform=transform,
    ) as out:  # fmt: skip
        out.write(pixels)
    return path


def place(x_m: float, y_m: float) -> tuple[float, float]:
    """Latitude and longitude of metres east and south of the raster's corner."""
    to_degrees = pyproj.Transformer.from_crs("EPSG:32640", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(500000 + x_m, 2800000 - y_m)
    return lat, lon


def test_land_cover_is_that_under_the_turned_footprint(tmp_path: Path) -> None:
    """Water west of x = 500 m, building east of it, bare land in the south."""
    classes = np.full((1, 1000, 1000), BUILDING, np.uint8)
    classes[0, :, :500] = WATER
    classes[0, 800:] = BARE
    cover = LandCover(raster(tmp_path / "c.tif", classes))
    assert cover.shares(*place(500, 400), 0) == pytest.approx({WATER: 0.5, BUILDING: 0.5}, abs=0.02)
    assert cover.shares(*place(500 - 128, 400), 0) == pytest.approx({WATER: 0.75, BUILDING: 0.25}, abs=0.02)
    # The same square turned by 45 degrees: its corner reaches the building, a triangle of (362 - 256)^2.
    turned = cover.shares(*place(500 - 256, 400), 45)
    assert turned[BUILDING] == pytest.approx((362 - 256) ** 2 / 512**2, abs=0.02)
    assert cover.shares(*place(0, 400), 90).get(0, 0) == pytest.approx(0.5, abs=0.02), "outside the map"


def test_columns_keep_their_place(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (4, 60, 90), np.uint8)
    whole = raster(tmp_path / "w.tif", pixels, 5.0)
    half = terrain.columns_of(whole, 50, tmp_path / "h.tif")
    with rasterio.open(whole) as a, rasterio.open(half) as b:
        assert (b.count, b.width, b.height, b.crs) == (3, 40, 60, a.crs)
        assert b.xy(7, 3) == a.xy(7, 53)
        assert np.array_equal(b.read(), a.read([1, 2, 3])[:, :, 50:])
    with pytest.raises(ValueError, match="below 90, found 90"):
        terrain.columns_of(whole, 90, tmp_path / "n.tif")


def test_the_table_counts_what_gates_let_through(tmp_path: Path) -> None:
    rows = [("desert", 2.0, ""), ("desert", 40.0, ""), ("desert", 90.0, "low_evidence"), ("mixed", None, "flat_frame")]
    frames = [Frame("f", f"{i}.png", kind, error, reason) for i, (kind, error, reason) in enumerate(rows)]
    made = terrain.table(frames)
    found = {row[0]: dict(zip(made.heads, row, strict=True)) for row in made.rows}
    assert list(found) == ["desert", "mixed", "all"]
    assert (found["desert"]["median m"], found["desert"]["> 25 m"], found["all"]["> 25 m"]) == ("40.00", "66.7 %", "75.0 %")
    assert (found["desert"]["accepted"], found["desert"]["accepted > 25 m"]) == ("66.7 %", "1 of 2")
    assert (found["all"]["held back by"], found["mixed"]["median m"]) == ("low_evidence 1, flat_frame 1", "-")
    stored = tmp_path / "frames.json"
    stored.write_text(
        json.dumps({"command": "made", "noise": "none", "bundle": "b (coarse 1)", "frames": [f.__dict__ for f in frames]})
    )
    assert terrain.main(["--from", str(stored), "--report", str(tmp_path / "r" / "README.md")]) == 0
    assert "| desert | 3 | 40.00 |" in (tmp_path / "r" / "README.md").read_text()


def test_what_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = raster(tmp_path / "m.tif", np.zeros((3, 8, 8), np.uint8))
    assert terrain.main(["--maps", str(plain), "--out", str(tmp_path / "o")]) == 2
    assert "m_classes.tif: expected the land cover" in capsys.readouterr().err
    assert terrain.main(["--dates", str(plain)]) == 2
    assert "two dates at least" in capsys.readouterr().err


def test_the_program_flies_and_answers(tmp_path: Path) -> None:
    """`simulate` over one map, `replay` on another, gates off and on."""
    if not NIGHTFIX.is_file():
        pytest.skip(f"no release build: {NIGHTFIX} is not there")
    rng = np.random.default_rng(5)
    rgb = np.kron(rng.integers(30, 230, (3, 40, 40), np.uint8), np.ones((1, 10, 10), np.uint8))
    known = raster(tmp_path / "known.tif", rgb, 5.0)
    seen = raster(tmp_path / "seen.tif", np.clip(rgb.astype(int) + rng.integers(-8, 8, rgb.shape), 1, 255).astype(np.uint8), 5.0)
    bundle = ROOT / "models" / "bundles" / "lite-1536"
    frames = terrain.fly(NIGHTFIX, bundle, seen, known, tmp_path / "f", ["--frames", "2"], "farmland, another date", None)
    assert [f.file for f in frames] == ["frames/00000.png", "frames/00001.png"]
    assert {f.terrain for f in frames} == {"farmland, another date"}
    assert all(f.error_m is not None or f.reason for f in frames)


@pytest.fixture(scope="module")
def golden() -> tuple:
    bundle = read_bundle(ROOT / "models" / "bundles" / "lite-1536")
    return bundle, features.at_stage_scale(bundle, bundle.golden["map_rgb"], 1.0)


def test_the_shipped_map_features_belong_to_the_map(golden: tuple) -> None:
    """The shipped graph: away from the rim a crop of the whole map's features is the crop's features."""
    at = features.differences(*golden)
    rim = features.rim_within(at)
    assert rim is not None and rim <= 48, at
    assert features.inside(at, 48) < 1e-5
    assert at[0] > 0.01, "the rim itself must differ, or nothing was compared"


def test_features_with_statistics_over_the_window_do_not(golden: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """As instance norm would leave them: the published encoder's features belong to their window."""
    plain = features.encode

    def windowed(bundle, image):
        found = plain(bundle, image)
        return found / found.std((1, 2), keepdims=True)

    monkeypatch.setattr(features, "encode", windowed)
    assert features.rim_within(features.differences(*golden)) is None
