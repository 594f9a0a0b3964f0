"""The published HDF5 layout: its traps, the draw of pairs, and the way to a recorded flight."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import rasterio
from conftest import ROOT
from PIL import Image
from pyproj import Geod, Transformer

from sthn.data import DataError, boson, open_source
from sthn.data.__main__ import main
from sthn.data.to_flight import Georeference

HEIGHT, WIDTH = 1500, 1300
STRIDE = 35


def big_map() -> np.ndarray:
    """A map whose rows and columns cannot be taken for one another: the project's own world, cut to be higher than wide."""
    with rasterio.open(ROOT / "tests/flights/procedural/world.tif") as file:
        half = np.moveaxis(file.read([1, 2, 3]), 0, -1)  # 2 m/px
    return np.ascontiguousarray(cv2.resize(half, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)[:HEIGHT, :WIDTH])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of five frames, 640 px, cut from the inverted gray of the map; one of them twice at one place."""
    out = tmp_path_factory.mktemp("boson")
    pixels = big_map()
    path = out / boson.MAP_NAME
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), pixels[..., ::-1])
    gray = np.pad(255 - pixels.mean(2).astype(np.uint8), 400, mode="reflect")
    places = [(700, 500), (700, 500), (640, 720), (900, 700), (1000, 620)]
    frames = [gray[r + 400 - 320 : r + 400 + 320, c + 400 - 320 : c + 400 + 320] for r, c in places]
    centres = [(r, c) for r in range(300, HEIGHT - 300, STRIDE) for c in range(300, WIDTH - 300, STRIDE)]
    blank = (np.zeros((8, 8), np.uint8) for _ in centres)
    for split in ("train", "test", "extended"):
        boson.write(out / f"{split}_queries.h5", frames, places)
        if split != "train":
            (out / f"{split}_database.h5").hardlink_to(out / "train_database.h5")
        else:
            boson.write(out / "train_database.h5", blank, centres)
    return out


def test_the_file_is_in_the_published_layout(folder: Path) -> None:
    with h5py.File(folder / "test_queries.h5") as file:
        data = file["image_data"]
        assert (data.dtype, data.shape, data.chunks, data.compression) == (np.uint8, (5, 640, 640, 3), (1, 640, 640, 3), "lzf")
        assert file["image_size"][()].tolist() == [[640, 640]] * 5
        assert [n.decode() for n in file["image_name"][()]][:3] == ["@700@500", "@700@500.00001", "@640@720"]


def test_a_name_is_row_first_and_the_truth_is_where_the_frame_was_cut(folder: Path) -> None:
    """The historic x/y swap: with it the frame would not be what the truth says it is."""
    pairs = boson.open_split(folder, "test", 1024, 200)
    assert len(pairs) == 5
    for index in range(len(pairs)):
        pair = pairs[index]
        query, centre = pairs.indices(index)
        row, column = pairs.queries.positions[query]
        assert (row, column) == pytest.approx([(700, 500), (700, 500), (640, 720), (900, 700), (1000, 620)][index], abs=1e-4)
        shift = pair.centre() - (pair.window_m - 1) / 2
        wanted = np.array([column, row]) - pairs.database.positions[centre][::-1]
        assert shift == pytest.approx(wanted, abs=1e-4) and np.hypot(*shift) <= 200
        x, y = np.round(pair.homography[:2, 2]).astype(int)
        under = 255 - pair.satellite[y : y + 512, x : x + 512].mean(2).astype(np.uint8)
        assert np.array_equal(under, pair.thermal)
        assert pair.surround.shape == (640, 640) and np.array_equal(pair.surround[64:-64, 64:-64], pair.thermal)


@pytest.mark.parametrize(("window", "first", "last"), [(512, 0.0, 255.0), (1024, 64.0, 191.0), (1536, 256 / 3, 170.6666667 - 1)])
def test_displacements_are_those_of_inclusive_corners(folder: Path, window: int, first: float, last: float) -> None:
    """W - 1 corners, and a centre of W / 2 - 0.5: `sthn-reference` 1.5 gives the numbers of a frame in the middle."""
    pairs = boson.open_split(folder, "test", window, 60)
    pair = pairs[2]
    t = pairs.offset_px(*pairs.indices(2)) / (window / 256)
    corner = pair.displacement(256) + np.array([[[0, 255], [0, 255]], [[0, 0], [255, 255]]])
    assert corner[0] == pytest.approx(np.array([[first, last]] * 2) + t[0], abs=1e-6)
    assert corner[1] == pytest.approx(np.array([[first] * 2, [last] * 2]) + t[1], abs=1e-6)


def test_windows_are_zero_outside_the_map(folder: Path) -> None:
    window = boson.MapImage(folder / boson.MAP_NAME).crop(10, WIDTH - 20, 512)
    assert not window[: 256 - 10].any() and not window[:, 256 + 20 :].any()
    assert np.array_equal(window[246:, :276], big_map()[:266, WIDTH - 276 :])
    assert not boson.MapImage(folder / boson.MAP_NAME).crop(-5000, 10, 64).any()


def test_centres_are_uniform_within_the_radius_and_seeded(folder: Path) -> None:
    pairs = boson.open_split(folder, "train", 512, 75)
    near = {i for i, p in enumerate(pairs.database.positions) if np.hypot(*(p - pairs.queries.positions[3])) <= 75}
    drawn = [pairs.reseeded((1, n)).indices(3)[1] for n in range(600)]
    counts = np.bincount(drawn, minlength=len(pairs.database))[sorted(near)]
    assert set(drawn) == near and len(near) > 8
    # Chi-squared of a uniform draw: mean n - 1, standard deviation sqrt(2 (n - 1)).
    expected, freedom = 600 / len(near), len(near) - 1
    assert ((counts - expected) ** 2 / expected).sum() < freedom + 5 * np.sqrt(2 * freedom)
    again = boson.open_split(folder, "train", 512, 75)
    assert [pairs.indices(i) for i in range(5)] == [again.indices(i) for i in range(5)]
    assert pairs.chosen() != pairs.reseeded(1).chosen()


def test_stored_pairs_come_back_the_same(folder: Path, tmp_path: Path) -> None:
    pairs = boson.open_split(folder, "test", 512, 120, seed=7)
    pairs.chosen().save(tmp_path / "pairs.json")
    again = boson.open_split(folder, "test", 512, 120, seed=8, pairs=tmp_path / "pairs.json")
    assert again.chosen() == pairs.chosen()
    assert np.array_equal(again[4].satellite, pairs[4].satellite) and np.array_equal(again[4].homography, pairs[4].homography)
    with pytest.raises(DataError, match="at most D_C = 10"):
        boson.open_split(folder, "test", 512, 10, pairs=tmp_path / "pairs.json")
    document = json.loads((tmp_path / "pairs.json").read_text())
    document["pairs"][1][0] = "@1@2"
    (tmp_path / "pairs.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="image_name: expected every name of the stored pairs, found no @1@2"):
        boson.open_split(folder, "test", 512, 120, pairs=tmp_path / "pairs.json")


def test_queries_without_a_centre_are_left_out(folder: Path) -> None:
    pairs = boson.open_split(folder, "test", 512, 12)
    assert 0 < len(pairs) < 5
    with pytest.raises(DataError, match="a query within 0.5 px"):
        boson.open_split(folder, "test", 512, 0.5)


def test_the_extended_set_with_the_test_region_is_refused_for_training(folder: Path, tmp_path: Path) -> None:
    spec = {"kind": "boson", "folder": str(folder), "split": "extended", "window_m": 512, "search_radius_m": 60}
    with pytest.raises(DataError, match="extended_queries_test_excluded.h5 beside it: this file holds the test region"):
        open_source(spec, purpose="train")
    assert len(open_source(spec | {"allow_test_region": True}, purpose="train")) == 5
    assert boson.queries_path(folder, "extended").name == "extended_queries.h5"
    # With both there, as in the release, the one without the test region: for any purpose, and whatever is allowed.
    for name in ("extended_queries.h5", "extended_queries_test_excluded.h5"):
        (tmp_path / name).touch()
    for purpose, allowed in (("train", False), ("train", True), ("evaluate", False)):
        assert boson.queries_path(tmp_path, "extended", purpose, allowed).name == "extended_queries_test_excluded.h5"


def test_no_data_of_others_are_in_the_repository() -> None:
    """Their licence forbids it: no HDF5, no weights in the authors' layout, no map, but of the project's own making."""
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode or not done.stdout:
        pytest.skip("not a git checkout")
    files = [Path(name) for name in done.stdout.splitlines()]
    ours = {Path("tests/flights/procedural") / name for name in ("world.tif", "world_classes.tif")}
    kinds = {".h5", ".hdf5", ".pth", ".tif", ".tiff"}
    assert [f for f in files if f.suffix.lower() in kinds and f not in ours] == []
    pictures = [f for f in files if f.suffix.lower() == ".png" and (ROOT / f).is_file()]
    assert [f for f in pictures if max(Image.open(ROOT / f).size) > 2048] == [], "no map"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.__delitem__("image_size"), r"image_size: expected \[5, 2\], found nothing"),
        (lambda f: f["image_size"].__setitem__((0, 0), 512), r"image_size: expected \(640, 640\) for every image"),
        (lambda f: f["image_name"].__setitem__(1, "700_500"), r"""image_name\[1\]: expected "@row@column", found '700_500'"""),
        (lambda f: f["image_name"].__setitem__(1, "@700@500"), "expected distinct names .* found @700@500 twice"),
        (lambda f: f.move("image_data", "images"), r"image_data: expected uint8 \[N, H, W, 3\], found nothing"),
    ],
)
def test_a_file_that_is_not_so_is_an_error_that_names_it(folder: Path, tmp_path: Path, change, said: str) -> None:
    path = tmp_path / "broken.h5"
    path.write_bytes((folder / "test_queries.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(DataError, match=said) as caught:
        boson.ImageFile(path)
    assert caught.value.file == str(path)


def test_what_is_not_hdf5_or_not_there_is_an_error_too(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("no")
    for name in ("a.h5", "b.h5"):
        with pytest.raises(DataError, match=f"{name}: file: expected a readable HDF5 file"):
            boson.ImageFile(tmp_path / name)
    with pytest.raises(DataError, match="expected the satellite map as an image, found nothing"):
        boson.MapImage(tmp_path / "map.png")


@pytest.fixture(scope="module")
def flight(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "f"
    words = ["to-flight", "--folder", str(folder), "--split", "test", "--search-radius-m", "200", "--out", str(out)]
    assert main(words) == 0
    return out


def test_truth_of_a_converted_flight_goes_back_to_the_pixel(folder: Path, flight: Path) -> None:
    rows = [dict(zip(*pair, strict=True)) for pair in _rows(flight)]
    pairs = boson.open_split(folder, "test", 512, 200)
    with rasterio.open(flight / "map.tif") as file:
        to_map = Transformer.from_crs(4326, file.crs, always_xy=True)
        assert np.array_equal(np.moveaxis(file.read(), 0, -1), big_map())
        for i, row in enumerate(rows):
            x, y = to_map.transform(float(row["truth_lon_deg"]), float(row["truth_lat_deg"]))
            column, line = ~file.transform @ (x, y)
            # A frame that begins 256 px before (row, column) has its middle at their common corner.
            assert (line, column) == pytest.approx(pairs.queries.positions[i], abs=0.01)
    for i, row in enumerate(rows):
        frame = cv2.imread(str(flight / row["file"]), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(frame, pairs.queries.gray(i))


def _rows(flight: Path):
    header, *lines = [line.split(",") for line in (flight / "poses.csv").read_text().splitlines()]
    return [(header, line) for line in lines]


def test_yaw_is_that_of_grid_north_against_true_north(flight: Path) -> None:
    """Going up a column of the map from the frame's position keeps to the azimuth that the flight states, and a pixel
    has the stated length: an independent way, through pyproj's factors of the projection."""
    from pyproj import Proj

    header, line = _rows(flight)[2]
    row = dict(zip(header, line, strict=True))
    factors = Proj("EPSG:32612").get_factors(float(row["truth_lon_deg"]), float(row["truth_lat_deg"]))
    # East of the central meridian grid north lies east of true north.
    assert float(row["yaw_deg"]) == pytest.approx(factors.meridian_convergence, abs=1e-3)
    assert 0.5 < float(row["yaw_deg"]) < 2 and row["yaw_deg"] == row["truth_yaw_deg"]
    assert float(row["gsd_m"]) == pytest.approx(1 / factors.meridional_scale, abs=1e-6)
    assert abs(float(row["gsd_m"]) - 1) < 1e-4, "a pixel is a metre on the ground"


def test_distances_of_the_invented_grid_are_metres() -> None:
    place = Georeference(9088, 23744)
    earth = Geod(ellps="WGS84")
    for row, column in [(0, 0), (9000, 23000), (4000, 12000)]:
        a, b = place.lat_lon(row, column), place.lat_lon(row + 300, column - 400)
        assert earth.inv(a[1], a[0], b[1], b[0])[2] == pytest.approx(500, abs=0.05)


def test_the_service_replays_a_converted_flight(flight: Path, tmp_path: Path) -> None:
    """The whole way: published layout -> flight -> the built program -> errors in metres."""
    built = [ROOT / f"target/{profile}/nightfix" for profile in ("release", "debug")]
    binary = next((path for path in built if path.is_file()), None)
    if binary is None:
        pytest.skip("no built nightfix in target/: the replay of a converted flight is not checked")
    bundle = ROOT / "models/bundles/lite-1536"
    command = [binary, "replay", flight, "--map", flight / "map.tif", "--bundle", bundle, "--gates", "off", "--out", tmp_path]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["frames"] == metrics["scored"] == 5
    assert metrics["error_m"]["median"] < 3, metrics
    assert metrics["mace_m"] < 8, metrics
