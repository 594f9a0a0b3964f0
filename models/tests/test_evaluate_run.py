"""The command, from a map to tables and figures: checkpoint, bundle and rival on the same pairs, with noise."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from conftest import ROOT, SMALL
from PIL import Image
from safetensors.torch import save_file

from sthn import export, geometry, procedural
from sthn.bundle import read_bundle
from sthn.data import Pair
from sthn.evaluate import figures, methods, pictures, run, tables
from sthn.evaluate.__main__ import main, parse_source
from sthn.evaluate.methods import BundleMethod, MethodError, Spec
from sthn.evaluate.results import PairScore, Results
from sthn.network import NetworkConfig

SCALE = 4
"""Metres per pixel of the maps' pairs: 128 px of frame, 192 px of window."""
COARSE = dataclasses.replace(SMALL, database_size=768 // SCALE, fine_padding=32 // SCALE)
WIDE = dataclasses.replace(SMALL, database_size=768, fine_padding=32)
"""Small inputs (64 px), but metres as published."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map and a released checkpoint of the small network."""
    folder = tmp_path_factory.mktemp("evaluation")
    rgb = np.kron(np.random.default_rng(1).integers(40, 220, (80, 80, 3), np.uint8), np.ones((16, 16, 1), np.uint8))
    profile = {"driver": "GTiff", "width": 1280, "height": 1280, "count": 3, "dtype": "uint8", "crs": "EPSG:32640"}
    with rasterio.open(folder / "m.tif", "w", transform=rasterio.transform.from_origin(5e5, 2.8e6, 1, 1), **profile) as out:
        out.write(np.moveaxis(rgb, -1, 0))
    released(COARSE, folder / "released")
    return folder


def released(config: NetworkConfig, folder: Path) -> Path:
    """A checkpoint as published, of weights by formula."""
    folder.mkdir()
    (folder / "config.json").write_text(config.to_json())
    state = procedural.network(config).state_dict()
    save_file({key: value.contiguous() for key, value in state.items()}, folder / "model.safetensors")
    return folder


def source(folder: Path) -> str:
    return f"maps:{folder}/m.tif,m_per_px={SCALE},frame_px={512 // SCALE}"


@pytest.fixture(scope="module")
def done(folder: Path) -> Results:
    """One run of everything: two kinds of noise, two D_C."""
    words = [source(folder), "--pairs", "2", "--radius-m", "50", "128", "--noise", "none", "rotation=10"]
    words += ["--method", f"net=checkpoint:{folder}/released", f"one=checkpoint:{folder}/released,stages=1"]
    words += ["rival:identity", "rival:orb+ransac", "rival:dhn"]
    assert main([*words, "--pictures", "2", "--seed", "3", "--out", str(folder / "out")]) == 0
    return Results.read(folder / "out")


def scores(results: Results, label: str) -> np.ndarray:
    return np.array([[s.corner_m for s in cell.scores] for _, cell in results.of(label)])


def test_every_method_saw_every_pair_of_every_condition(done: Results) -> None:
    assert [c.key for c in done.conditions] == [(50, "none"), (50, "rotation 10"), (128, "none"), (128, "rotation 10")]
    assert [m.label for m in done.methods] == ["net", "one", "identity", "ORB + RANSAC", "DHN"]
    assert [m.window_m for m in done.methods] == [768, 768, 512, 512, 512]
    assert len(done.cells) == 4 * 5 and len({c.digest for c in done.conditions}) == 4


def test_identity_has_the_error_of_its_prior(done: Results) -> None:
    for condition, cell in done.of("identity"):
        for pair, score in zip(condition.pairs, cell.scores, strict=True):
            centre = np.mean(pair.truth, axis=0)
            assert score.centre_m == pytest.approx(np.hypot(*centre), abs=0.01)
            assert score.centre_m <= condition.search_radius_m


def test_noise_changes_the_frame_and_not_its_place(done: Results) -> None:
    plain, turned = (next(c for c in done.conditions if c.key == (128, kind)) for kind in ("none", "rotation 10"))
    for a, b in zip(plain.pairs, turned.pairs, strict=True):
        assert a.name == b.name
        assert np.allclose(np.mean(a.truth, 0), np.mean(b.truth, 0), atol=0.01)
        assert np.abs(np.array(a.truth) - b.truth).max() > 1
        assert np.allclose(np.linalg.norm(np.array(b.truth) - np.mean(b.truth, 0), axis=1), 512 / np.sqrt(2), atol=0.01)


def test_the_stages_are_told_apart(done: Results) -> None:
    assert np.abs(scores(done, "net") - scores(done, "one")).max() > 1
    stages = {name for _, cell in done.of("net") for s in cell.scores for name in s.stages_s}
    assert stages == {"coarse", "refine"}
    pictured = [s for _, cell in done.of("net") for s in cell.scores]
    assert all(s.coarse is not None and s.coarse != s.quad for s in pictured)
    assert all(s.coarse is None for _, cell in done.of("one") for s in cell.scores)


def test_a_bundle_answers_as_its_checkpoint(tmp_path: Path) -> None:
    """Two implementations of one network, ONNX Runtime and PyTorch, both stages."""
    checkpoint = released(WIDE, tmp_path / "released")
    assert export.main([str(checkpoint), "--out", str(tmp_path / "bundle"), "--name", "small"]) == 0
    window = procedural.image(768)
    truth = np.array([[1.0, 0, 100], [0, 1, 175], [0, 0, 1]])
    pair = Pair("p", window, procedural.frame_of(window), truth)
    torch_match, bundle_match = (
        Spec.parse(t).open(128).match(pair) for t in (f"checkpoint:{checkpoint}", f"bundle:{tmp_path}/bundle")
    )
    assert np.abs(torch_match.coarse - bundle_match.coarse).max() < 0.05
    found = [geometry.apply(m.homography, geometry.edge_corners(512)) for m in (torch_match, bundle_match)]
    assert np.abs(found[0] - found[1]).max() < 0.05


def test_a_rival_without_weights_has_a_note_and_no_number(done: Results) -> None:
    (row,) = [line for line in (done.folder / "table_1.csv").read_text().splitlines() if line.startswith("DHN")]
    assert row == "DHN,-,-,-,no weights here"


def test_the_same_seed_gives_the_same_scores(folder: Path, done: Results) -> None:
    words = [source(folder), "--pairs", "2", "--radius-m", "128", "--noise", "rotation=10", "--seed"]
    out = {seed: folder / f"again-{seed}" for seed in ("3", "4")}
    for seed, path in out.items():
        assert main([*words, seed, "--method", "rival:identity", "--out", str(path)]) == 0
    same, other = (Results.read(path) for path in out.values())
    assert same.conditions[0].digest == done.conditions[3].digest != other.conditions[0].digest
    assert [s.corner_m for s in same.cells[0].scores] == list(scores(done, "identity")[3])


def colours(path: Path) -> dict[str, int]:
    """How many pixels are plainly green, blue and red."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    r, g, b = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    return {
        "truth": int(((g > 150) & (r < 90) & (b < 90)).sum()),
        "coarse": int(((b > 190) & (r < 100) & (g < 150)).sum()),
        "final": int(((r > 200) & (g < 90) & (b < 90)).sum()),
    }


def test_sheets_show_truth_coarse_and_final(done: Results, tmp_path: Path) -> None:
    out = str(done.folder)
    record = done.conditions[0].pairs[0]
    quads = {"coarse": (np.array(record.truth) - 60).tolist(), "quad": (np.array(record.truth) + 60).tolist()}
    tile = pictures.Tile(done.folder, record, PairScore(84.9, 84.9, **quads), "net", 768)
    found = colours(pictures.sheet([[tile]], tmp_path / "s.png"))
    assert min(found.values()) > 300, found
    assert figures.main(["sheet", out, "--pick", "worst", "--pairs", "1", "--out", str(tmp_path / "all.png")]) == 0
    assert figures.main(["noise", out, "--one", "one", "--two", "net", "--pairs", "1", "--out", str(tmp_path / "n.jpg")]) == 0
    boxes = ["boxes", "--none", out, "--widening", out, "--full", out, "--method", "net", "--pairs", "1"]
    assert figures.main([*boxes, "--out", str(tmp_path / "b.jpg")]) == 0
    assert (tmp_path / "b-stages.png").is_file()


def test_curves_are_the_tables_numbers(done: Results, tmp_path: Path) -> None:
    out = str(done.folder)
    assert figures.main(["windows", out, "--out", str(tmp_path / "w.png")]) == 0
    assert figures.main(["tgm", "--with", out, "--without", out, "--method", "net", "--out", str(tmp_path / "t.png")]) == 0
    curve = figures.curve(figures.gather([done]), "net")
    assert curve == [(50, pytest.approx(scores(done, "net")[0].mean())), (128, pytest.approx(scores(done, "net")[2].mean()))]


def test_figures_say_what_is_missing(done: Results, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(done.folder)
    assert figures.main(["sheet", out, "--method", "absent", "--out", str(tmp_path / "s.png")]) == 1
    assert "absent" in capsys.readouterr().err
    assert figures.main(["tgm", "--with", out, "--without", out, "--out", str(tmp_path / "t.png")]) == 1
    assert "expected one of net, one" in capsys.readouterr().err
    stored = json.loads((done.folder / "results.json").read_text())
    for condition in stored["conditions"]:
        condition["pairs"] = [{k: p[k] for k in ("name", "terrain")} for p in condition["pairs"]]
    (tmp_path / "results.json").write_text(json.dumps(stored))
    assert figures.main(["sheet", str(tmp_path), "--out", str(tmp_path / "s.png")]) == 1
    assert "--pictures N" in capsys.readouterr().err


def test_the_light_bundle_gives_its_golden_answer() -> None:
    """The adapter of correlation bundles: window with margin in, homography in that window out."""
    bundle = read_bundle(ROOT / "models" / "bundles" / "lite-1536")
    margin = bundle.manifest["window_margin_m"]
    move = np.array([[1, 0, margin], [0, 1, margin], [0, 0, 1]])
    truth = move @ bundle.golden["homography"]
    pair = Pair("golden", bundle.golden["map_rgb"], bundle.golden["frame"], truth)
    match = BundleMethod(bundle).match(pair)
    assert np.abs(match.homography - truth).max() < 1e-2
    assert match.coarse is not None and {"coarse_s", "refine_s", "peak_mass"} <= match.detail.keys()
    with pytest.raises(MethodError, match="expected a frame of 512 px, found 256"):
        BundleMethod(bundle).match(dataclasses.replace(pair, thermal=pair.thermal[::2, ::2]))


def test_a_coarse_answer_that_is_not_finite_is_not_drawn(folder: Path) -> None:
    """A pictured pair like any other: no number, and the run goes on."""
    method = Spec.parse(f"checkpoint:{folder}/released").open(50)
    pair = Pair("p", procedural.image(768 // SCALE), np.zeros((128, 128), np.uint8), np.eye(3), m_per_px=SCALE)
    found = dataclasses.replace(method.match(pair), coarse=np.full((4, 2), np.nan))
    method.match = lambda _: found
    score = run.match_one(method, pair, keep_quads=True)
    assert score.coarse is None and score.quad is not None


def test_the_results_are_there_though_the_tables_fail(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """UASTHN's evaluation stops on an undefined name after its metrics and before its results are saved."""
    monkeypatch.setattr(tables, "tables", lambda _: (_ for _ in ()).throw(NameError("x")))
    with pytest.raises(NameError):
        main([source(folder), "--pairs", "1", "--radius-m", "50", "--method", "rival:identity", "--out", str(tmp_path)])
    assert len(Results.read(tmp_path).cells[0].scores) == 1


def test_a_bundle_is_told_which_pixels_were_seen() -> None:
    """As the service tells it: what stands where nothing was seen does not matter."""
    bundle = read_bundle(ROOT / "models" / "bundles" / "lite-1536")
    margin = bundle.manifest["window_margin_m"]
    truth = np.array([[1, 0, margin], [0, 1, margin], [0, 0, 1]]) @ bundle.golden["homography"]
    pair = Pair("golden", bundle.golden["map_rgb"], bundle.golden["frame"], truth)
    seen = np.ones((512, 512), bool)
    seen[:, 400:] = False
    black, white = (dataclasses.replace(pair, thermal=np.where(seen, pair.thermal, v).astype(np.uint8)) for v in (0, 255))
    method = BundleMethod(bundle)
    told = [method.match(dataclasses.replace(p, seen=seen)).homography for p in (black, white)]
    assert np.array_equal(*told) and np.abs(told[0] - method.match(white).homography).max() > 1e-6


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("lite-1536", "KIND:WHAT"),
        ("model:x", "KIND:WHAT"),
        ("bundle:", "nothing"),
        ("bundle:b,levels=4", "options stages"),
        ("checkpoint:c,levels=four", "with a number"),
        ("checkpoint:c,lookup=inwards", r"lookup: expected published \| map_indexed \| frame_indexed, found inwards"),
        ("bundle:absent", "bundle.toml"),
        ("bundle:absent,stages=3", "expected 1 or 2"),
        ("checkpoint:absent.pth", "expected window, levels=N"),
        ("rival:surf", "unknown surf"),
        ("rival:orb+ransac,window=256", "at least 512"),
    ],
)
def test_a_method_that_cannot_be_is_named(text: str, said: str) -> None:
    with pytest.raises(MethodError, match=said):
        Spec.parse(text).open(512)


def test_all_rivals_but_those_with_a_line_of_their_own() -> None:
    specs = methods.parse_all(["bundle:b", "rival:all", "mine=rival:sift+ransac,window=1024"])
    names = [spec.what for spec in specs]
    assert names.count("sift+ransac") == 1 and {"identity", "ihn", "stgl-gem"} <= set(names)
    assert specs[-1].label == "mine"


def test_sources_are_named_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert parse_source("boson:a/b,split=test") == {"kind": "boson", "folder": "a/b", "split": "test"}
    assert parse_source("maps:a.tif+b.tif,m_per_px=0.25") == {"kind": "maps", "maps": ["a.tif", "b.tif"], "m_per_px": 0.25}
    file = tmp_path / "s.toml"
    file.write_text('[source]\nkind = "flight"\nfolder = "f"\nmap = "m.tif"\nseed = 9\nwindow_m = 512\n')
    assert parse_source(str(file)) == {"kind": "flight", "folder": "f", "map": "m.tif"}
    for wrong in ("a/b", "hdf5:x", "maps:a,window_m=3", f"{tmp_path}/absent.toml"):
        assert main([wrong, "--method", "rival:identity", "--out", str(tmp_path / "o")]) == 2
        assert "evaluate: " in capsys.readouterr().err
