"""Shared by the tests: where the project's data lies, and small networks that run in milliseconds."""

from pathlib import Path

import pytest
import torch

from sthn import export, procedural
from sthn.network import NetworkConfig, Sthn

ROOT = Path(__file__).resolve().parents[2]
SHARED = (ROOT / ".." / "shared").resolve()
DATA = Path(__file__).parent / "data"

SMALL = NetworkConfig(
    resize_width=64, database_size=128, corr_level=2, iters_lev0=3, iters_lev1=2, fine_padding=4, two_stages=True
)
"""The published architecture at a quarter of its size."""


@pytest.fixture
def shared() -> Path:
    """The shared data, where there are any."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no shared data: {SHARED / 'data'} is not there")
    return SHARED / "data"


@pytest.fixture(scope="session")
def small() -> Sthn:
    """A small two-stage network with weights made by formula."""
    torch.manual_seed(0)
    return procedural.network(SMALL)


@pytest.fixture(scope="session")
def published_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of the published architecture at full size, with the weights of the committed parity case. Never committed:
    it is made here, through the command."""
    folder = tmp_path_factory.mktemp("bundle") / "published-1536"
    assert export.main(["--random-weights", "0", "--out", str(folder), "--name", "published-1536"]) == 0
    return folder
