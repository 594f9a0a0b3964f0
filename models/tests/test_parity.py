"""The published numbers, and the command that compares with them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import DATA, SMALL
from PIL import Image
from safetensors.torch import save_file

from sthn import parity, procedural
from sthn.network import Sthn


def test_the_published_code_is_reproduced_on_the_committed_case() -> None:
    found = parity.check(DATA / "procedural_1536.npz")
    assert {"coarse_iterations", "fine_iterations", "flow_bbox", "final", "satellite_256_sum"} <= found.keys()
    assert all(value <= parity.TOLERANCES[name] for name, value in found.items()), found
    assert found["end_to_end"] < 1e-3, "smooth images leave no room for rounding"


@pytest.mark.parametrize("case", ["one_stage_512", "two_stage_1536"])
def test_the_published_code_is_reproduced_on_the_stored_cases(
    shared: Path, case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert parity.main([str(shared / "reference_parity" / case)]) == 0, capsys.readouterr()
    assert "feature_satellite" in capsys.readouterr().out


@pytest.fixture
def case(small: Sthn, tmp_path: Path) -> Path:
    """A small case in the stored layout, from our own network."""
    (tmp_path / "config.json").write_text(SMALL.to_json())
    save_file({key: value.contiguous() for key, value in small.state_dict().items()}, tmp_path / "model.safetensors")
    window, frame = procedural.image(128), procedural.image(96)[:64, 20:84, 0]
    Image.fromarray(window).save(tmp_path / "satellite.png")
    Image.fromarray(frame).save(tmp_path / "thermal.png")
    with torch.inference_mode():
        match = small(parity.to_tensor(window), parity.to_tensor(frame))
    arrays = {
        "satellite_256": match.satellite,
        "coarse_iterations": match.coarse_iterations,
        "flow_bbox": match.box.flow(128),
        "crop_256": match.crop,
        "fine_iterations": match.fine_iterations,
        "final": match.final,
    }
    np.savez(tmp_path / "expected.npz", **{name: value.numpy() for name, value in arrays.items()})
    return tmp_path


def rewrite(case: Path, **changes: np.ndarray | None) -> None:
    with np.load(case / "expected.npz") as archive:
        arrays = {name: archive[name] for name in archive.files} | changes
    np.savez(case / "expected.npz", **{name: value for name, value in arrays.items() if value is not None})


def test_an_untouched_case_passes(case: Path) -> None:
    assert parity.main([str(case)]) == 0


@pytest.mark.parametrize("name", ["satellite_256", "coarse_iterations", "flow_bbox", "crop_256", "fine_iterations", "final"])
@pytest.mark.parametrize("change", [1.0, np.nan])
def test_every_array_can_fail(case: Path, name: str, change: float, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load(case / "expected.npz") as archive:
        value = archive[name].copy()
    # The first iteration of several: nothing downstream depends on it.
    value.flat[0] += change * 2 * parity.TOLERANCES[name]
    rewrite(case, **{name: value})
    assert parity.main([str(case)]) == 1
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[-1] for line in lines if line[0] == name] == ["FAILED"]


@pytest.mark.parametrize("name", ["coarse_iterations", "flow_bbox", "fine_iterations", "final"])
def test_a_missing_array_is_named(case: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    rewrite(case, **{name: None})
    assert parity.main([str(case)]) == 1
    assert f"missing {name}" in capsys.readouterr().err


def test_an_unknown_array_or_shape_is_named(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rewrite(case, surprise=np.zeros(3))
    assert parity.main([str(case)]) == 1
    assert "surprise" in capsys.readouterr().err
    rewrite(case, surprise=None, final=np.zeros((2, 2, 2, 2), np.float32))
    assert parity.main([str(case)]) == 1
    assert "final" in capsys.readouterr().err


def test_nothing_to_check_is_a_failure(tmp_path: Path) -> None:
    assert parity.main([str(tmp_path)]) == 1
    assert parity.main([str(tmp_path / "absent")]) == 1
