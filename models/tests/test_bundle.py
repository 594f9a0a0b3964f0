"""The door of every bundle: what it writes, and what it refuses."""

import copy
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper

from sthn import geometry
from sthn import manifest as rules
from sthn.bundle import BundleError, golden_arrays, in_memory, read_bundle, write_bundle

FILE = {"file": "a.onnx", "sha256": "0" * 64}


def matcher_manifest(two_stages: bool = True) -> dict[str, Any]:
    """A tiny bundle: window 128 m in 64 px, frame 64 m in 32 px."""
    stage = {
        "kind": "matcher",
        "lookup": "published",
        "tolerance_px": 1e-3,
        "match_sigma_m": 10.0,
        "map": {"size_px": 64, "width_m": 128.0, "content": "rgb", "resize": "align_corners_antialias"},
        "frame": {"size_px": 32, "width_m": 64.0, "content": "gray", "resize": "half_pixel_antialias"},
    }
    manifest = {
        "schema": 1,
        "name": "tiny",
        "licence": "MIT",
        "provenance": {"description": 'a "test"\nwith é', "command": "pytest", "data": ["none"], "seed": 3},
        "window_width_m": 128.0,
        "window_margin_m": 0.0,
        "frame_width_m": 64.0,
        "m_per_px": 1.0,
        "search_radius_m": 32.0,
        "tone_mapping": 1,
        "opset": 17,
        "coarse": stage,
    }
    if two_stages:
        refine = copy.deepcopy(stage) | {"crop": {"shape": "bounding_box", "padding_m": 4.0}}
        refine["map"]["resize"] = "align_corners_bilinear"
        manifest["refine"] = refine
    return manifest


def correlation_manifest() -> dict[str, Any]:
    manifest = matcher_manifest(two_stages=False)
    manifest["window_margin_m"] = 16.0
    manifest["coarse"] = {
        "kind": "correlation",
        "stride": 2,
        "rotations_deg": [-5.0, 0.0, 5.0],
        "scales": [1.0],
        "subcell_radius": 2,
        "tolerance": 1e-3,
        "match_sigma_m": 10.0,
        "map": {"size_px": 80, "width_m": 160.0, "content": "rgb", "resize": "half_pixel_antialias"},
        "frame": {"size_px": 32, "width_m": 64.0, "content": "gray_mask", "resize": "half_pixel_antialias"},
    }
    return manifest


def model(inputs: dict[str, list[Any]], output: str, factor: float, shape: list[int] | None = None) -> bytes:
    """output = factor * mean(first input) over all, as `shape`; or factor * first input."""
    first = next(iter(inputs))
    nodes = [helper.make_node("Mul", ["last" if shape else first, "factor"], [output])]
    constants = [helper.make_tensor("factor", TensorProto.FLOAT, [], [factor])]
    if shape:
        constants.append(helper.make_tensor("shape", TensorProto.INT64, [len(shape)], shape))
        nodes[:0] = [
            helper.make_node("ReduceMean", [first], ["mean"], keepdims=1),
            helper.make_node("Expand", ["mean", "wide"], ["last0"]),
            helper.make_node("Reshape", ["last0", "shape"], ["last"]),
        ]
        constants.append(helper.make_tensor("wide", TensorProto.INT64, [4], [1, 1, 1, int(np.prod(shape))]))
    used = [name for node in nodes for name in node.input]
    for name in inputs:  # an input that is not used would be no input
        if name not in used:
            nodes.append(helper.make_node("Identity", [name], [f"{name}_again"]))
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, dims) for name, dims in inputs.items()],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, None)],
        constants,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9).SerializeToString()


def matcher_graphs(factor: float = 2.0) -> dict[str, bytes]:
    encoder = model({"map": [1, 3, 64, 64]}, "map_features", 0.5)
    matcher = model({"map_features": [1, 3, 64, 64], "frame": ["batch", 1, 32, 32]}, "displacement", factor, [1, 2, 2, 2])
    return {"coarse_map": encoder, "coarse": matcher, "refine_map": encoder, "refine": matcher}


def with_place(golden: dict[str, np.ndarray], manifest: dict[str, Any]) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(1)
    spec = manifest["coarse"]["map"]
    side = int(manifest["window_width_m"] + 2 * manifest["window_margin_m"])
    final = generator.normal(0, 3, (2, 2, 2))
    homography = geometry.homography_of_displacement(
        64, spec["size_px"], final, spec["width_m"] / spec["size_px"], manifest["window_margin_m"]
    )
    return golden | {
        "map_rgb": generator.integers(0, 256, (side, side, 3), dtype=np.uint8),
        "frame": generator.integers(0, 256, (64, 64), dtype=np.uint8),
        "final": final,
        "homography": homography,
    }


def matcher_golden(two_stages: bool = True) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    inputs, outputs = {}, {}
    for stage in ["coarse", "refine"][: 1 + two_stages]:
        image = generator.random((1, 3, 64, 64), dtype=np.float32)
        inputs |= {f"{stage}_map": {"map": image}, stage: {"frame": generator.random((1, 1, 32, 32), dtype=np.float32)}}
        outputs |= {
            f"{stage}_map": {"map_features": image / 2},
            stage: {"displacement": np.full((1, 2, 2, 2), 2 * (image / 2).mean())},
        }
    return with_place(golden_arrays(inputs, outputs), matcher_manifest(two_stages))


def test_a_matcher_bundle_there_and_back(tmp_path: Path) -> None:
    folder = tmp_path / "tiny"
    differences = write_bundle(folder, matcher_manifest(), matcher_graphs(), matcher_golden())
    assert set(differences) == {f"{g}.out.{o}" for g in ("coarse", "refine") for o in ("displacement",)} | {
        "coarse_map.out.map_features",
        "refine_map.out.map_features",
    }
    assert max(differences.values()) < 1e-5
    assert {path.name for path in folder.iterdir()} == {
        *("bundle.toml", "golden.npz", "coarse_map.onnx", "coarse.onnx", "refine_map.onnx", "refine.onnx")
    }
    bundle = read_bundle(folder)
    assert bundle.check() == differences
    assert bundle.manifest["provenance"] == matcher_manifest()["provenance"]
    assert bundle.manifest["coarse"]["map_graph"]["file"] == "coarse_map.onnx"
    text = (folder / "bundle.toml").read_text()
    assert "window_width_m = 128.0  # W_S" in text and text.index("[coarse]") < text.index("[refine]")


def test_a_correlation_bundle_there_and_back(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    map_image, frame = (generator.random(shape, dtype=np.float32) for shape in ((1, 3, 80, 80), (3, 2, 32, 32)))
    graphs = {
        "coarse_map": model({"map": [1, 3, 80, 80]}, "map_features", 0.5),
        "coarse": model({"frame": ["batch", 2, 32, 32]}, "frame_features", 3.0),
    }
    golden = golden_arrays(
        {"coarse_map": {"map": map_image}, "coarse": {"frame": frame}},
        {"coarse_map": {"map_features": map_image / 2}, "coarse": {"frame_features": frame * 3}},
    )
    manifest = correlation_manifest()
    write_bundle(tmp_path / "light", manifest, graphs, with_place(golden, manifest))
    assert read_bundle(tmp_path / "light").run("coarse", frame=frame)["frame_features"].shape == (3, 2, 32, 32)


def test_writing_twice_gives_the_same_bytes_and_keeps_what_stands_beside(tmp_path: Path) -> None:
    folder = tmp_path / "tiny"
    write_bundle(folder, matcher_manifest(), matcher_graphs(), matcher_golden())
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "curve.csv").write_text("kept")
    write_bundle(folder, matcher_manifest(), matcher_graphs(), matcher_golden())
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before | {"curve.csv": b"kept"}


def test_a_one_stage_bundle_replaces_a_two_stage_one(tmp_path: Path) -> None:
    folder = tmp_path / "tiny"
    write_bundle(folder, matcher_manifest(), matcher_graphs(), matcher_golden())
    graphs = {name: graph for name, graph in matcher_graphs().items() if name.startswith("coarse")}
    write_bundle(folder, matcher_manifest(False), graphs, matcher_golden(False))
    assert not (folder / "refine.onnx").exists()
    assert "refine" not in read_bundle(folder).manifest


def test_graphs_that_do_not_give_torchs_numbers_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "tiny"
    write_bundle(folder, matcher_manifest(), matcher_graphs(), matcher_golden())
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(BundleError, match=r"coarse\.out\.displacement: expected a difference of at most 0\.001"):
        write_bundle(folder, matcher_manifest(), matcher_graphs(2.01), matcher_golden())
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before, "a refused bundle changes nothing"
    golden = matcher_golden()
    golden["refine.out.displacement"] = golden["refine.out.displacement"] * np.float32("nan")
    with pytest.raises(BundleError, match=r"refine\.out\.displacement"):
        write_bundle(tmp_path / "other", matcher_manifest(), matcher_graphs(), golden)
    assert not (tmp_path / "other").exists()


def drop(name: str) -> Callable[[dict[str, np.ndarray]], object]:
    return lambda golden: golden.pop(name)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (drop("map_rgb"), "map_rgb"),
        (drop("homography"), "homography"),
        (drop("coarse_map.in.map"), r"coarse_map\.in\.map"),
        (drop("refine.in.frame"), r"refine\.in\.frame"),
        (drop("refine.out.displacement"), r"refine\.out\.displacement"),
        (lambda g: g.update(frame=g["frame"][:-1]), r"frame: expected uint8 \(64, 64\)"),
        (lambda g: g.update(final=g["final"].astype(np.float32)), "final: expected float64"),
        (lambda g: g.update(final=g["final"] + 0.01), "homography: expected the one of `final`"),
        (lambda g: g.update(surprise=np.zeros(1, np.float32)), "surprise"),
        (lambda g: g.update({"coarse.out.covariance": np.zeros((1, 4, 4), np.float32)}), r"coarse\.out\.covariance"),
    ],
)
def test_a_golden_pair_that_is_not_whole_is_refused(change: Callable, named: str, tmp_path: Path) -> None:
    golden = matcher_golden()
    change(golden)
    with pytest.raises(BundleError, match=named):
        write_bundle(tmp_path / "tiny", matcher_manifest(), matcher_graphs(), golden)


def test_a_golden_pair_over_10_mib_is_refused(tmp_path: Path) -> None:
    golden = matcher_golden()
    golden["coarse.in.noise"] = np.random.default_rng(0).random(3 << 20, dtype=np.float32)
    with pytest.raises(BundleError, match="expected at most 10485760 bytes"):
        write_bundle(tmp_path / "tiny", matcher_manifest(), matcher_graphs(), golden)


def test_other_folders_are_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(BundleError, match="other files"):
        write_bundle(tmp_path, matcher_manifest(), matcher_graphs(), matcher_golden())
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize(("graph", "port"), [("coarse_map", "map"), ("coarse", "frame")])
def test_graphs_whose_inputs_do_not_fit_are_named(graph: str, port: str) -> None:
    graphs = matcher_graphs()
    wrong = {"map": model({"image": [1, 3, 64, 64]}, "map_features", 1.0), "frame": graphs["coarse_map"]}[port]
    with pytest.raises(BundleError, match=f"{graph}: inputs: expected"):
        in_memory(matcher_manifest(), graphs | {graph: wrong})
    narrow = {
        "map": model({"map": [1, 3, 32, 32]}, "map_features", 1.0),
        "frame": model({"map_features": [1, 3, 64, 64], "frame": [1, 3, 32, 32]}, "displacement", 2.0, [1, 2, 2, 2]),
    }[port]
    with pytest.raises(BundleError, match=rf"{graph}: {port}: expected \[batch, "):
        in_memory(matcher_manifest(), graphs | {graph: narrow})


def test_missing_and_unknown_graphs_are_named() -> None:
    graphs = matcher_graphs()
    with pytest.raises(BundleError, match=r"refine\.map_graph|graphs: expected"):
        in_memory(matcher_manifest(), {name: graphs[name] for name in ("coarse_map", "coarse", "refine")})
    with pytest.raises(BundleError, match="found middle"):
        in_memory(matcher_manifest(), graphs | {"middle": graphs["coarse"]})
    with pytest.raises(BundleError, match="coarse: "):
        in_memory(matcher_manifest(), graphs | {"coarse": b"no graph"})


@pytest.mark.parametrize("name", ["coarse.onnx", "golden.npz"])
def test_a_changed_file_is_named(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "tiny"
    write_bundle(folder, matcher_manifest(), matcher_graphs(), matcher_golden())
    content = bytearray((folder / name).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / name).write_bytes(content)
    with pytest.raises(BundleError, match=f"{name}: expected sha256"):
        read_bundle(folder)
    (folder / name).unlink()
    with pytest.raises(BundleError, match=name):
        read_bundle(folder)


def complete(manifest: dict[str, Any]) -> dict[str, Any]:
    manifest["golden"] = dict(FILE)
    for name in ("coarse", "refine"):
        if name in manifest:
            manifest[name] |= {"map_graph": dict(FILE), "graph": dict(FILE)}
    return manifest


def paths(table: dict[str, Any], prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    out = []
    for name, value in table.items():
        out.append((*prefix, name))
        if isinstance(value, dict):
            out += paths(value, (*prefix, name))
    return out


OPTIONAL = {("refine",), ("provenance", "seed"), ("accuracy",)}
ALL = [(kind, path) for kind, make in (("m", matcher_manifest), ("c", correlation_manifest)) for path in paths(complete(make()))]


@pytest.mark.parametrize(("kind", "path"), [entry for entry in ALL if entry[1] not in OPTIONAL], ids=str)
def test_every_field_is_needed_and_typed(kind: str, path: tuple[str, ...]) -> None:
    for how in ("missing", "wrong"):
        manifest = complete(matcher_manifest() if kind == "m" else correlation_manifest())
        rules.check(manifest)
        table = manifest
        for name in path[:-1]:
            table = table[name]
        if how == "missing":
            del table[path[-1]]
        else:
            table[path[-1]] = True
        with pytest.raises(rules.ManifestError, match=path[-1]):
            rules.check(manifest)


@pytest.mark.parametrize("where", [(), ("coarse",), ("refine", "crop"), ("coarse", "map"), ("provenance",), ("golden",)])
def test_an_unknown_field_is_named(where: tuple[str, ...]) -> None:
    manifest = complete(matcher_manifest())
    table = manifest
    for name in where:
        table = table[name]
    table["colour"] = 1.0
    with pytest.raises(rules.ManifestError, match="colour"):
        rules.check(manifest)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("schema", 2),
        ("tone_mapping", 2),
        ("m_per_px", 2.0),
        ("search_radius_m", 1000.0),
        ("window_width_m", 128.5),
        ("coarse.map.width_m", 256.0),
        ("coarse.map.content", "gray"),
        ("coarse.map.resize", "supersample"),
        ("coarse.lookup", "Published"),
        ("coarse.tolerance_px", 0.0),
        ("coarse.match_sigma_m", float("nan")),
        ("coarse.crop", {"shape": "oriented", "padding_m": 0.0}),
        ("refine.map.resize", "supersample"),
        ("refine.crop.shape", "oriented"),
        ("golden.file", "../golden.npz"),
        ("golden.sha256", "A" * 64),
        ("name", ""),
    ],
)
def test_values_that_do_not_fit_are_named(field: str, value: object) -> None:
    manifest = complete(matcher_manifest())
    *where, name = field.split(".")
    table = manifest
    for part in where:
        table = table[part]
    table[name] = value
    with pytest.raises(rules.ManifestError):
        rules.check(manifest)


def test_a_manifest_reads_back_as_it_was_written() -> None:
    for manifest in (complete(matcher_manifest()), complete(correlation_manifest())):
        manifest["name"] = 'a\\b"c\x7f\té'
        assert tomllib.loads(rules.to_toml(manifest)) == manifest
