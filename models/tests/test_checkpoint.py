"""Released layouts, and what is refused."""

import dataclasses
import json
import pickle
from pathlib import Path

import pytest
import torch
from conftest import SMALL
from safetensors.torch import save_file

from sthn.checkpoint import CheckpointError, load_checkpoint, one_stage
from sthn.network import ConfigError, NetworkConfig, Sthn


def same(a: Sthn, b: Sthn) -> bool:
    mine, other = a.state_dict(), b.state_dict()
    return mine.keys() == other.keys() and all(torch.equal(mine[key], other[key]) for key in mine)


def stages(network: Sthn, prefix: str = "") -> dict[str, dict[str, torch.Tensor]]:
    return {
        name: {prefix + key: value for key, value in getattr(network, name).state_dict().items()}
        for name in ("netG", "netG_fine")
    }


def directory(folder: Path, state: dict[str, torch.Tensor], config: dict | None = None) -> Path:
    (folder / "config.json").write_text(json.dumps({"model_config": config or dataclasses.asdict(SMALL)}))
    save_file({key: value.contiguous() for key, value in state.items()}, folder / "model.safetensors")
    return folder


def test_released_parameter_counts() -> None:
    config = NetworkConfig(256, 1536, 4, 6, 6, 32, True)
    network = Sthn(config)
    count = {name: sum(p.numel() for p in getattr(network, name).parameters()) for name in ("netG", "netG_fine")}
    assert count == {"netG": 1_625_794, "netG_fine": 1_439_170}
    assert not list(network.buffers())


def test_a_directory_with_safetensors(small: Sthn, tmp_path: Path) -> None:
    loaded = load_checkpoint(directory(tmp_path, small.state_dict()))
    assert same(loaded, small)
    assert loaded.config == SMALL and not loaded.training


def test_a_directory_with_a_pickle_instead(small: Sthn, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(SMALL.to_json())
    torch.save(small.state_dict(), tmp_path / "pytorch_model.bin")
    assert same(load_checkpoint(tmp_path), small)


@pytest.mark.parametrize("prefix", ["", "module."])
def test_a_training_checkpoint(small: Sthn, tmp_path: Path, prefix: str) -> None:
    torch.save(stages(small, prefix), tmp_path / "STHN.pth")
    assert same(load_checkpoint(tmp_path / "STHN.pth", SMALL), small)


def test_a_training_checkpoint_needs_a_configuration(small: Sthn, tmp_path: Path) -> None:
    torch.save(stages(small), tmp_path / "STHN.pth")
    with pytest.raises(CheckpointError, match="correlation levels"):
        load_checkpoint(tmp_path / "STHN.pth")


def test_a_fine_network_of_its_own(small: Sthn, tmp_path: Path) -> None:
    torch.save(stages(small) | {"netG_fine": None}, tmp_path / "coarse.pth")
    torch.save({"netG": stages(small)["netG_fine"], "netG_fine": None}, tmp_path / "fine.pth")
    assert same(load_checkpoint(tmp_path / "coarse.pth", SMALL, fine=tmp_path / "fine.pth"), small)
    with pytest.raises(CheckpointError, match=r"missing netG_fine\."):
        load_checkpoint(tmp_path / "coarse.pth", SMALL)


@pytest.mark.parametrize("key", ["netG.fnet1.conv1.bias", "netG_fine.update_block_4.cnn.layer10.3.weight"])
def test_a_missing_key_is_named(small: Sthn, tmp_path: Path, key: str) -> None:
    state = small.state_dict()
    del state[key]
    with pytest.raises(CheckpointError, match=f"missing {key}$"):
        load_checkpoint(directory(tmp_path, state))


def test_an_extra_key_is_named(small: Sthn, tmp_path: Path) -> None:
    state = small.state_dict() | {"netG.fnet1.norm1.weight": torch.zeros(64)}
    with pytest.raises(CheckpointError, match="unexpected netG.fnet1.norm1.weight$"):
        load_checkpoint(directory(tmp_path, state))
    torch.save(stages(small) | {"optimizer": {}}, tmp_path / "STHN.pth")
    with pytest.raises(CheckpointError, match="unexpected optimizer$"):
        load_checkpoint(tmp_path / "STHN.pth", SMALL)


def test_a_fine_network_that_a_one_stage_configuration_does_not_know(small: Sthn, tmp_path: Path) -> None:
    config = dataclasses.asdict(SMALL) | {"two_stages": False}
    with pytest.raises(CheckpointError, match=r"unexpected netG_fine\."):
        load_checkpoint(directory(tmp_path, small.state_dict(), config))


def test_levels_come_from_the_configuration(small: Sthn, tmp_path: Path) -> None:
    """The community's ONNX fork loads 4-level weights into the default of 2 with strict=False: it must not load."""
    config = dataclasses.asdict(SMALL) | {"corr_level": 3}
    with pytest.raises(CheckpointError, match=r"layer1\.0\.weight: expected shape \(128, 245, 3, 3\), found \(128, 164, 3, 3\)"):
        load_checkpoint(directory(tmp_path, small.state_dict(), config))
    del config["corr_level"]
    with pytest.raises(ConfigError, match="missing corr_level"):
        load_checkpoint(directory(tmp_path, small.state_dict(), config))


def test_the_fine_network_has_two_levels_whatever_the_coarse_one_has() -> None:
    network = Sthn(dataclasses.replace(SMALL, corr_level=3))
    assert network.netG.update_block_4.cnn.layer1[0].in_channels == 3 * 81 + 2
    assert network.netG_fine.update_block_4.cnn.layer1[0].in_channels == 2 * 81 + 2


@pytest.mark.parametrize(
    ("field", "value"),
    [("resize_width", 250), ("corr_level", 9), ("corr_level", True), ("iters_lev0", 0), ("fine_padding", -1), ("two_stages", 1)],
)
def test_a_wrong_number_is_named(field: str, value: object) -> None:
    with pytest.raises(ConfigError, match=field):
        NetworkConfig.from_dict(dataclasses.asdict(SMALL) | {field: value})


def test_an_unknown_field_is_named() -> None:
    with pytest.raises(ConfigError, match="unknown weight"):
        NetworkConfig.from_dict(dataclasses.asdict(SMALL) | {"weight": True})


def test_weights_that_are_not_finite_are_refused(small: Sthn, tmp_path: Path) -> None:
    state = {key: value.clone() for key, value in small.state_dict().items()}
    state["netG.fnet1.conv2.bias"][3] = float("nan")
    with pytest.raises(CheckpointError, match=r"netG\.fnet1\.conv2\.bias: expected finite"):
        load_checkpoint(directory(tmp_path, state))


class Trap:
    def __reduce__(self) -> tuple:
        return (pytest.fail, ("code of a pickle was run",))


def test_a_pickle_cannot_run_code(tmp_path: Path) -> None:
    (tmp_path / "STHN.pth").write_bytes(pickle.dumps({"netG": Trap()}, protocol=2))
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path / "STHN.pth", SMALL)


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04" + bytes(40)])
def test_a_file_that_is_none_is_an_error_with_its_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "config.json").write_text(SMALL.to_json())
    for name, where in (("model.safetensors", tmp_path), ("STHN.pth", tmp_path / "STHN.pth")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CheckpointError, match=name):
            load_checkpoint(where, None if where.is_dir() else SMALL)


def test_the_coarse_stage_alone(small: Sthn) -> None:
    alone = one_stage(small)
    assert alone.netG is small.netG and alone.netG_fine is None and not alone.config.two_stages
