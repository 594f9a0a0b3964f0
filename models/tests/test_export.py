"""Export: what is written is what torch computes, or nothing is written."""

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from conftest import DATA, SMALL
from safetensors.torch import save_file

from sthn import export, pipeline, procedural
from sthn.bundle import BundleError, in_memory, read_bundle
from sthn.checkpoint import one_stage
from sthn.network import Lookup, Sthn
from sthn.parity import to_tensor
from sthn.train import experiment, saving

WIDE = dataclasses.replace(SMALL, database_size=768, fine_padding=32)
"""Small inputs (64 px), but metres as published."""


@pytest.fixture(scope="module")
def network() -> Sthn:
    return procedural.network(WIDE)


def write(network: Sthn, folder: Path) -> dict[str, float]:
    provenance = {"description": "test", "command": "pytest", "data": []}
    return export.export(network, folder, "small", "MIT", provenance, 128.0, {"coarse": 10.0, "refine": 5.0})


def test_the_published_numbers_come_out_of_the_bundle(published_bundle: Path) -> None:
    """From decoded pixels through ONNX Runtime and numpy: what the authors' code gave for the same pair."""
    match = pipeline.match_pair(read_bundle(published_bundle), procedural.image(1536), procedural.thermal())
    with np.load(DATA / "procedural_1536.npz") as stored:
        assert np.abs(match.final - stored["final"][0]).max() < 2e-3


def test_a_published_bundle_states_what_feeds_it(published_bundle: Path) -> None:
    bundle = read_bundle(published_bundle)
    coarse, refine = bundle.manifest["coarse"], bundle.manifest["refine"]
    assert coarse["lookup"] == refine["lookup"] == "published"
    assert coarse["map"] == {"size_px": 256, "width_m": 1536.0, "content": "rgb", "resize": "align_corners_antialias"}
    assert coarse["frame"] == {"size_px": 256, "width_m": 512.0, "content": "gray_thrice", "resize": "half_pixel_antialias"}
    assert refine["crop"] == {"shape": "bounding_box", "padding_m": 32.0}
    assert bundle.manifest["search_radius_m"] == 512
    assert (published_bundle / "golden.npz").stat().st_size < 10 << 20
    differences = bundle.check(export.EXPORT_TOLERANCE_PX)
    assert {"coarse.out.iterations", "refine.out.iterations"} <= differences.keys()
    for graph in published_bundle.glob("*.onnx"):
        model = onnx.load(graph)
        onnx.checker.check_model(model)
        assert "GridSample" not in {node.op_type for node in model.graph.node}
        assert [opset.version for opset in model.opset_import] == [bundle.manifest["opset"]]


def test_two_stages_there_and_back(network: Sthn, tmp_path: Path) -> None:
    assert max(write(network, tmp_path / "b").values()) <= export.EXPORT_TOLERANCE_PX
    bundle = read_bundle(tmp_path / "b")
    window = procedural.image(768)
    frame = procedural.frame_of(window)
    with torch.inference_mode():
        expected = network(to_tensor(window), to_tensor(frame))
    found = pipeline.match_pair(bundle, window, frame)
    assert np.abs(found.final - expected.final[0].numpy()).max() < 2e-3


def test_several_frames_of_one_map(network: Sthn) -> None:
    encoder, matcher = export.export_matcher(network.netG, 64)
    graphs = {"coarse_map": encoder, "coarse": matcher}
    manifest = export.manifest_of(
        one_stage(network), "x", "MIT", {"description": "d", "command": "c", "data": []}, 50.0, {"coarse": 1.0}
    )
    bundle = in_memory(manifest, graphs)
    generator = torch.Generator().manual_seed(9)
    image, frames = torch.rand(1, 3, 64, 64, generator=generator), torch.rand(5, 3, 64, 64, generator=generator)
    features = bundle.run("coarse_map", map=image.numpy())["map_features"]
    found = bundle.run("coarse", map_features=features, frame=frames.numpy())
    with torch.inference_mode():
        expected = network.netG(image.expand(5, -1, -1, -1), frames).numpy()
    assert found["iterations"].shape == (3, 5, 2, 2, 2)
    assert np.abs(found["iterations"] - expected).max() < 1e-3
    assert np.array_equal(found["displacement"], found["iterations"][-1])


@pytest.mark.parametrize("lookup", list(Lookup))
def test_every_direction_is_exported_and_stated(lookup: Lookup, tmp_path: Path) -> None:
    network = Sthn(dataclasses.replace(WIDE, two_stages=False), lookup).eval()
    network.load_state_dict(one_stage(procedural.network(WIDE)).state_dict())
    write(network, tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    assert bundle.manifest["coarse"]["lookup"] == lookup.value
    assert "refine" not in bundle.manifest


def test_graphs_of_other_weights_are_refused(network: Sthn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the exporter had made a wrong graph: nothing is written."""
    other = export.graphs_of(procedural.network(WIDE, seed=1))
    monkeypatch.setattr(export, "graphs_of", lambda _: other)
    with pytest.raises(BundleError, match=r"px from torch at most|expected a difference"):
        write(network, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_a_graph_fixed_to_its_example_is_refused(network: Sthn, monkeypatch: pytest.MonkeyPatch) -> None:
    real = export.to_onnx
    monkeypatch.setattr(export, "to_onnx", lambda module, examples, outputs, dynamic: real(module, examples, outputs, {}))
    with pytest.raises(Exception, match=r"(?i)dimension|shape"):
        export.export_matcher(network.netG, 64)


def test_one_tensor_for_two_inputs_is_refused(network: Sthn) -> None:
    same = torch.rand(1, 256, 16, 16)
    with pytest.raises(BundleError, match="distinct"):
        export.to_onnx(export.FrameMatcher(network.netG), {"map_features": same, "frame": same}, ["displacement"], {})


def test_the_command_exports_a_checkpoint(network: Sthn, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = tmp_path / "released"
    checkpoint.mkdir()
    (checkpoint / "config.json").write_text(WIDE.to_json())
    save_file({key: value.contiguous() for key, value in network.state_dict().items()}, checkpoint / "model.safetensors")
    assert export.main([str(checkpoint), "--out", str(tmp_path / "b"), "--name", "n", "--padding", "8", "--one-stage"]) == 0
    assert "coarse.out.displacement" in capsys.readouterr().out
    assert "refine" not in read_bundle(tmp_path / "b").manifest
    assert export.main([str(checkpoint), "--out", str(tmp_path / "b"), "--name", "n", "--padding", "8"]) == 0
    assert read_bundle(tmp_path / "b").manifest["refine"]["crop"]["padding_m"] == 8
    (checkpoint / "model.safetensors").unlink()
    assert export.main([str(checkpoint), "--out", str(tmp_path / "c"), "--name", "n"]) == 1
    assert "model.safetensors" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_a_training_of_ours_says_what_it_was_and_how_good(
    network: Sthn, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not the authors' release with the paper's numbers: row, sources, D_C and sigmas are the run's."""
    source = {"kind": "maps", "maps": ["area.tif"], "count": 3}
    tables = {"network": {"levels": 2}, "data": {"train": source | {"augment": True}, "validation": source}}
    made = experiment.parse({"row": "own night", "window_m": 768, "search_radius_m": 90, "seed": 7} | tables, "e.toml")
    (tmp_path / "experiment.json").write_text(json.dumps(dataclasses.asdict(made)))
    saving.save_released(network, tmp_path / "best")
    words = [str(tmp_path / "best"), "--out", str(tmp_path / "b"), "--name", "n"]
    assert export.main(words) == 1
    assert "expected --coarse-sigma-m, --refine-sigma-m, found none" in capsys.readouterr().err
    rows = "step,seconds,identity_m,mace_coarse_m,mace_m,not_finite\n1,1,60,25.06,12.53,0\n2,2,60,50.12,37.59,0\n"
    (tmp_path / "validation.csv").write_text(rows)
    assert export.main([*words, "--refine-sigma-m", "6"]) == 0
    manifest = read_bundle(tmp_path / "b").manifest
    assert (manifest["coarse"]["match_sigma_m"], manifest["refine"]["match_sigma_m"]) == (20.0, 6.0)
    assert manifest["search_radius_m"] == 90 and manifest["provenance"]["seed"] == 7
    assert "own night" in manifest["provenance"]["description"] and "STHN" not in manifest["provenance"]["description"]
    assert manifest["provenance"]["data"][0] == "train: kind maps, maps ['area.tif']"
    assert manifest["licence"].startswith("unknown")
    origin = export.origin_of(tmp_path / "final")
    assert origin.sigma_m == {"coarse": 40.0, "refine": 30.0}, "the last row's"
    (tmp_path / "experiment.json").unlink()
    assert (
        not export.origin_of(tmp_path / "best").sigma_m
        and "apart from its run" in export.origin_of(tmp_path / "best").description
    )


def options(**given: object) -> argparse.Namespace:
    base = {"checkpoint": None, "window": None, "levels": None, "padding": None, "one_stage": False, "fine": None}
    return argparse.Namespace(**(base | given))


def test_a_pth_does_not_get_its_levels_by_guess(tmp_path: Path) -> None:
    path = tmp_path / "STHN.pth"
    torch.save({"netG": {}, "netG_fine": None}, path)
    with pytest.raises(BundleError, match="--levels"):
        export._config(options(checkpoint=path, window=1536))
    config = export._config(options(checkpoint=path, window=1024, levels=4, one_stage=True))
    assert (config.database_size, config.corr_level, config.fine_padding, config.two_stages) == (1024, 4, 32, False)


def test_weights_by_formula_take_the_papers_levels() -> None:
    assert export._config(options(window=512)).corr_level == 2
    assert export._config(options()).corr_level == 4
