"""DHN, IHN and LocalTrans: forward, backward, the small loop, weights on disk."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT

from sthn import geometry, rivals
from sthn.data.pair import Pair
from sthn.rivals import learned, localtrans, train
from sthn.rivals.base import translation

SIDE = 32


class Shifted:
    """Blobs; the frame is the window's content moved by up to 12 px, and both are `SIDE` px over 32 m."""

    name, window_m, search_radius_m = "shifted", SIDE, 12.0

    def __init__(self, seed: tuple[int, ...] = (8,)) -> None:
        self.seed = seed

    def reseeded(self, seed: tuple[int, ...]) -> "Shifted":
        return Shifted(seed)

    def __len__(self) -> int:
        return 64

    def __getitem__(self, index: int) -> Pair:
        rng = np.random.default_rng([*self.seed, index])
        x, y = rng.integers(-6, 7, 2)
        big = np.zeros((SIDE + 16, SIDE + 16))
        grid = np.arange(SIDE + 16)
        for _ in range(5):
            cx, cy, width = *rng.uniform(8, SIDE + 8, 2), rng.uniform(2, 4)
            big += np.exp(-((grid[None] - cx) ** 2 + (grid[:, None] - cy) ** 2) / (2 * width**2))
        big = np.clip(big * 160, 0, 255).astype(np.uint8)
        window, frame = big[8 : 8 + SIDE, 8 : 8 + SIDE], big[8 + y : 8 + y + SIDE, 8 + x : 8 + x + SIDE]
        return Pair(f"shifted-{index}", np.repeat(window[..., None], 3, 2), frame.copy(), translation(x, y))


class Still(Shifted):
    """The same pairs in every pass: few enough to learn by heart in seconds."""

    def reseeded(self, seed: tuple[int, ...]) -> "Still":
        return self


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.mark.parametrize("key, iterations", [("dhn", 1), ("ihn", 6), ("localtrans", 3)])
def test_forward_and_backward(key: str, iterations: int) -> None:
    torch.manual_seed(0)
    net = learned.NETWORKS[key][1](64)
    map_image, frame = torch.rand(2, 2, 3, 64, 64)
    out = net(map_image, frame)
    assert out.shape == (iterations, 2, 2, 2, 2)
    train.loss_of(out, torch.ones(2, 2, 2, 2)).backward()
    unused = [name for name, p in net.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
    assert not unused


def test_dhn_has_the_papers_size() -> None:
    with torch.device("meta"):
        net = learned.NETWORKS["dhn"][1](128)
    assert net.head[2].in_features == 128 * 16 * 16  # Fig. 4: 16 x 16 x 128 before the dense layer
    assert sum(p.numel() for p in net.parameters()) == 34_193_800  # "over 34 million"


def test_local_attention_sees_its_neighbourhood_only() -> None:
    torch.manual_seed(0)
    q, k, v = torch.rand(3, 1, 4, 12, 12)
    far = k.clone()
    far[:, :, 9:] += 5
    for radius, row, moved in ((2, 5, False), (2, 7, True)):
        a, b = (localtrans.local_attention(q, key, v, radius)[0] for key in (k, far))
        assert torch.allclose(a[:, :, row], b[:, :, row]) != moved
    _, attention = localtrans.local_attention(q, k, v, 2)
    assert torch.allclose(attention.sum(1), torch.ones(1, 12, 12), atol=1e-5)
    assert (attention.view(1, 5, 5, 12, 12)[:, :2, :, 0] == 0).all()  # above the first row there is nothing


def test_localtrans_warps_by_the_truth() -> None:
    rng = torch.Generator().manual_seed(1)
    features = torch.rand(1, 2, 16, 16, generator=rng)
    matrix = torch.tensor([[[1.0, 0, 8], [0, 1, 4], [0, 0, 1]]])  # input pixels; 2 and 1 cells at stride 4
    warped = localtrans.warp(features, matrix, 4)
    assert torch.allclose(warped[:, :, :-1, :-2], features[:, :, 1:, 2:], atol=1e-5)


def test_loss_weighs_the_last_iteration_most() -> None:
    displacements = torch.zeros(2, 1, 2, 2, 2)
    displacements[0] += 1
    truth = torch.zeros(1, 2, 2, 2)
    assert train.loss_of(displacements, truth).item() == pytest.approx(0.85)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("ihn")
    train.train("ihn", Still(), out, steps=30, seed=3, side_px=SIDE, batch=4, peak=1e-3)
    return out


def test_a_short_run_learns_and_is_marked(trained: Path) -> None:
    (rival,) = rivals.available(["ihn"], ihn=trained)
    assert rival.ready and rival.note == "short run, 30 steps" and rival.window_m == SIDE
    source = Shifted()
    errors, identity = [], []
    for index in range(16):
        pair = source[index]
        match = rival.match(pair)
        found = geometry.apply(match.homography, geometry.edge_corners(SIDE))
        errors.append(np.linalg.norm(found - pair.quad(), axis=1).mean())
        identity.append(np.linalg.norm(geometry.edge_corners(SIDE) - pair.quad(), axis=1).mean())
    assert np.mean(errors) < 0.6 * np.mean(identity), (np.mean(errors), np.mean(identity))


def test_training_goes_on_bit_for_bit(tmp_path: Path) -> None:
    # DHN: dropout and running statistics must go on too.
    words = {"steps": 4, "seed": 1, "side_px": SIDE, "batch": 2}
    train.train("dhn", Shifted(), tmp_path / "whole", **words)
    train.train("dhn", Shifted(), tmp_path / "parts", **words, stop_after=2)
    assert not (tmp_path / "parts" / "weights.pt").exists()
    train.train("dhn", Shifted(), tmp_path / "parts", **words)
    whole, parts = (torch.load(tmp_path / n / "weights.pt", weights_only=True) for n in ("whole", "parts"))
    assert all(torch.equal(whole[key], parts[key]) for key in whole)
    assert len((tmp_path / "parts" / "curve.csv").read_text().splitlines()) == 5
    with pytest.raises(rivals.RivalError, match="recipe"):
        train.train("dhn", Shifted(), tmp_path / "parts", **{**words, "seed": 2})


def test_every_pass_draws_anew_and_the_same_in_every_run() -> None:
    places = [place for step in train.plan(64, 16, 8, seed=2) for place in step]
    assert [sorted(i for p, i in places if p == passed) for passed in (0, 1)] == [list(range(64))] * 2
    first, second = (train.Inputs(Shifted(), SIDE, seed=2)[passed, 5] for passed in (0, 1))
    assert not torch.equal(first[0], second[0]) and not torch.equal(first[2], second[2])
    again = train.Inputs(Shifted(), SIDE, seed=2)[1, 5]
    assert all(torch.equal(a, b) for a, b in zip(second, again, strict=True))


def test_without_weights_there_is_no_number(trained: Path, tmp_path: Path) -> None:
    (rival,) = rivals.available(["ihn"])
    assert not rival.ready and rival.note == rivals.NO_WEIGHTS
    with pytest.raises(rivals.RivalError, match="IHN: cannot match shifted-0: no weights here"):
        rival.match(Shifted()[0])
    with pytest.raises(rivals.RivalError, match="rival: expected dhn, found ihn"):
        rivals.available(["dhn"], dhn=trained)
    with pytest.raises(rivals.RivalError, match="training.json"):
        rivals.available(["ihn"], ihn=tmp_path)
    (tmp_path / "training.json").write_text(json.dumps({"rival": "ihn", "side_px": "128"}))
    with pytest.raises(rivals.RivalError, match="side_px: expected int, found '128'"):
        rivals.available(["ihn"], ihn=tmp_path)


def test_another_window_is_refused(trained: Path) -> None:
    (rival,) = rivals.available(["ihn"], ihn=trained)
    pair = Shifted()[0]
    wide = Pair("wide", np.zeros((64, 64, 3), np.uint8), pair.thermal, pair.homography)
    with pytest.raises(rivals.RivalError, match="expected a window of 32 m, found 64 m"):
        rival.match(wide)


def test_the_command_trains_over_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = str(ROOT / "tests/flights/procedural/world.tif")
    words = ["--window-m", "1024", "--m-per-px", "8", "--search-radius-m", "200", "--side-px", "64", "--batch", "2"]
    out = tmp_path / "ihn"
    assert train.main(["ihn", "--maps", world, *words, "--steps", "2", "--out", str(out)]) == 0
    (rival,) = rivals.available(["ihn"], ihn=out)
    assert rival.window_m == 1024 and rival.note == "short run, 2 steps"
    assert json.loads((out / "training.json").read_text())["search_radius_m"] == 200
    assert train.main(["ihn", "--out", str(tmp_path)]) == 2
    assert "expected one of --data and --maps" in capsys.readouterr().err
    data = tmp_path / "data.toml"
    data.write_text("[training]\n")
    assert train.main(["ihn", "--data", str(data), "--out", str(tmp_path)]) == 2
    assert "train: expected a table, found None" in capsys.readouterr().err
