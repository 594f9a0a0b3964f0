"""From released checkpoints to bundles: both layouts, the stored numbers, the command's words."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SMALL
from PIL import Image
from safetensors.torch import save_file

from sthn import convert, export, pipeline, procedural
from sthn.bundle import BundleError, read_bundle
from sthn.network import Sthn
from sthn.parity import to_tensor

WIDE = dataclasses.replace(SMALL, database_size=768, fine_padding=0)
"""Small inputs (64 px), metres as published; the padding of a released config."""


@pytest.fixture(scope="module")
def network() -> Sthn:
    return procedural.network(dataclasses.replace(WIDE, fine_padding=32))


@pytest.fixture(scope="module")
def case(network: Sthn, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A released folder with a stored case beside it, from the formula's weights and images."""
    folder = tmp_path_factory.mktemp("released")
    (folder / "config.json").write_text(WIDE.to_json())
    save_file({k: v.contiguous() for k, v in network.state_dict().items()}, folder / "model.safetensors")
    window = procedural.image(768)
    frame = procedural.frame_of(window)
    Image.fromarray(window).save(folder / "satellite.png")
    Image.fromarray(frame).save(folder / "thermal.png")
    with torch.inference_mode():
        final = network(to_tensor(window), to_tensor(frame)).final.numpy()
    np.savez(folder / "expected.npz", final=final)
    return folder


def test_a_released_folder_with_its_stored_numbers(case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert convert.main([str(case), "--out", str(tmp_path / "sthn-768")]) == 0
    manifest = read_bundle(tmp_path / "sthn-768").manifest
    assert manifest["name"] == "sthn-768"
    assert manifest["licence"].startswith("unknown"), "the hub's tag and the data's gate disagree: nobody says it for the user"
    assert manifest["refine"]["crop"]["padding_m"] == 32, "the paper's, not the released config's 0"
    assert "stored parity case" in capsys.readouterr().out
    # The same bundle beside other stored numbers.
    with np.load(case / "expected.npz") as archive:
        moved = archive["final"] + 0.011
    for name in ("satellite.png", "thermal.png"):
        (tmp_path / name).write_bytes((case / name).read_bytes())
    np.savez(tmp_path / "expected.npz", final=moved)
    with pytest.raises(BundleError, match="final: expected 0.01 px at most"):
        convert.compare(tmp_path / "sthn-768", tmp_path, 32)


def test_a_pth_with_module_gives_the_same_bundle(
    network: Sthn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The authors' other layout, from DataParallel. A .pth states no sizes: W_R is 256 for all, here 64."""
    stages = {
        name: {f"module.{key}": value for key, value in getattr(network, name).state_dict().items()}
        for name in ("netG", "netG_fine")
    }
    torch.save(stages, tmp_path / "STHN.pth")
    words = [str(tmp_path / "STHN.pth"), "--out", str(tmp_path / "b")]
    assert convert.main(words) == 1
    assert "--levels" in capsys.readouterr().err
    monkeypatch.setattr(export, "_config", lambda options: dataclasses.replace(WIDE, fine_padding=options.padding))
    assert convert.main([*words, "--window", "768", "--levels", "2"]) == 0
    window = procedural.image(768)
    found = pipeline.match_pair(read_bundle(tmp_path / "b"), window, procedural.frame_of(window))
    with torch.inference_mode():
        expected = network(to_tensor(window), to_tensor(procedural.frame_of(window))).final[0].numpy()
    assert np.abs(found.final - expected).max() < 2e-3


def test_what_is_not_there_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert convert.main([str(tmp_path / "absent"), "--out", str(tmp_path / "b")]) == 1
    assert "absent: expected a folder or a .pth file, found nothing" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("name", ["one_stage_512", "two_stage_1536"])
def test_the_published_numbers_come_out_of_the_bundle(
    shared: Path, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The published code's own numbers, at full size, through ONNX Runtime."""
    assert convert.main([str(shared / "reference_parity" / name), "--out", str(tmp_path / name)]) == 0
    said = next(line for line in capsys.readouterr().out.splitlines() if "stored parity case" in line)
    assert float(said.split()[-1]) <= convert.PARITY_TOLERANCE_PX
