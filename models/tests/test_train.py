"""Training: losses against the paper's equations, the box's augmentation, the order of pairs, and going on bit for bit."""

from __future__ import annotations

import csv
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import torch
from conftest import ROOT, SMALL
from safetensors.torch import load_file

from sthn.checkpoint import CheckpointError, load_checkpoint
from sthn.data import DataError, Pair
from sthn.evaluate.methods import Spec
from sthn.network import Lookup, NetworkConfig, Sthn, bounding_box
from sthn.train import box, experiment, loop, saving
from sthn.train.__main__ import main
from sthn.train.experiment import BoxTable
from sthn.train.stream import Steps, Stream
from sthn.train.task import SthnTask, sequence_loss

TINY = NetworkConfig(resize_width=32, database_size=64, corr_level=2, iters_lev0=2, iters_lev1=2, fine_padding=4, two_stages=True)


def images(count: int, side: int, frame: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    window = torch.randint(0, 256, (count, side, side, 3), generator=generator, dtype=torch.uint8)
    return window, torch.randint(0, 256, (count, frame, frame), generator=generator, dtype=torch.uint8)


def test_the_coarse_loss_is_equation_3() -> None:
    generator = torch.Generator().manual_seed(1)
    steps, truth = torch.randn(6, 3, 2, 2, 2, generator=generator), torch.randn(3, 2, 2, 2, generator=generator)
    wanted = sum(0.85 ** (6 - k - 1) * (steps[k] - truth).abs().mean().item() for k in range(6))
    assert sequence_loss(steps, truth, 0.85).item() == pytest.approx(wanted, rel=1e-6)


def test_the_fine_loss_is_equation_5_with_kappa_in_front() -> None:
    """kappa L1(D_RB->RT - its truth): mapped to the coarse scale, both sides move by the box alike."""
    torch.manual_seed(0)
    task = SthnTask(Sthn(SMALL))
    window, thermal = images(2, 128, 64)
    truth = torch.randn(2, 2, 2, 2)
    drawn = torch.tensor([[3.0, -5.0, 8.0], [-4.0, 6.0, 12.0]])
    out = task(window, thermal, truth, drawn)
    with torch.no_grad():
        match = task.network(
            window.permute(0, 3, 1, 2) / 255,
            thermal[:, None].expand(-1, 3, -1, -1) / 255,
            lambda d: box.augmented(d, SMALL, drawn),
        )
    eta = match.box.width / SMALL.resize_width
    kappa = (eta / SMALL.alpha)[:, None, None, None]
    inside = (truth - match.box.flow(128) / SMALL.alpha) / kappa  # the truth in pixels of the crop
    wanted = 0.0
    for k, step in enumerate(match.fine_iterations):
        wanted += 0.85 ** (len(match.fine_iterations) - k - 1) * (kappa * (step - inside).abs()).mean().item()
    assert out["loss_fine"].item() == pytest.approx(wanted, rel=1e-4)
    assert out["loss"].item() == pytest.approx(out["loss_coarse"].item() + out["loss_fine"].item(), rel=1e-6)  # (6)


def test_coarse_and_fine_learn_from_their_own_loss() -> None:
    torch.manual_seed(0)
    task = SthnTask(Sthn(SMALL))
    out = task(*images(2, 128, 64), torch.randn(2, 2, 2, 2), torch.zeros(2, 3))
    out["loss_fine"].backward(retain_graph=True)
    assert all(p.grad is None for p in task.nets()["netG"].parameters()), "detached between the stages"
    out["loss_coarse"].backward()
    for name, net in task.nets().items():
        grads = [p.grad for p in net.parameters()]
        assert all(g is not None and torch.isfinite(g).all() for g in grads) and sum(float(g.norm()) for g in grads) > 0, name


def test_half_precision_is_for_convolutions_only() -> None:
    torch.manual_seed(0)
    task = SthnTask(Sthn(SMALL)).eval()
    batch = (*images(2, 128, 64), torch.zeros(2, 2, 2, 2))
    with torch.no_grad():
        whole = task(*batch)["coarse"]
        with torch.autocast("cpu", torch.bfloat16):
            half = task(*batch)["coarse"]
            features = task.network.netG.encode(torch.rand(1, 3, 64, 64))
    assert features.dtype == torch.bfloat16 and half.dtype == torch.float32
    assert 0 < (half - whole).abs().max() < 0.1 * whole.abs().max() + 0.05
    # A displacement kept in bfloat16 would have 8 bits: its last ones are there.
    assert (half.bfloat16().float() != half).any()


@pytest.mark.parametrize(
    ("table", "moves", "widens"),
    [
        (BoxTable(), 64, 64),
        (BoxTable(rule="paper"), 64, 128),
        (BoxTable(kind="widen"), 0, 64),
        (BoxTable(kind="none"), 0, 0),
        (BoxTable(centre_px=16, widen_px=8), 16, 8),
    ],
)
def test_bounds_of_the_box_augmentation(table: BoxTable, moves: float, widens: float) -> None:
    drawn = box.draw(table, 4000, torch.Generator().manual_seed(0))
    assert drawn[:, :2].abs().max() <= moves and 0 <= drawn[:, 2].min() and drawn[:, 2].max() <= widens
    if moves:
        assert drawn[:, :2].min() < -0.98 * moves and drawn[:, :2].max() > 0.98 * moves
        assert abs(float(torch.corrcoef(drawn[:, :2].T)[0, 1])) < 0.05, "each axis its own"
    if widens:
        assert drawn[:, 2].max() > 0.98 * widens and drawn[:, 2].mean() == pytest.approx(widens / 2, rel=0.05)


def test_training_pads_the_box_by_its_augmentation_alone_and_evaluation_by_twice_32() -> None:
    config = dataclasses.replace(SMALL, fine_padding=32)
    still = torch.zeros(1, 2, 2, 2)
    tight = box.augmented(still, config, torch.zeros(1, 3))
    moved = box.augmented(still, config, torch.tensor([[10.0, -20.0, 6.0]]))
    evaluated = bounding_box(still, config)
    assert (tight.left.item(), tight.width.item()) == (0.0, 128.0)
    assert (moved.left.item(), moved.top.item(), moved.width.item()) == (10 - 3, -20 - 3, 134)
    assert evaluated.width.item() == 128 + 2 * 32


class Numbered:
    """A source whose pairs say which they are and of which draw."""

    window_m, search_radius_m = 64, 5.0

    def __init__(self, name: str, count: int, seed=0) -> None:
        self.name, self.count, self.seed = name, count, seed

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Pair:
        pixels = np.zeros((64, 64, 3), np.uint8)
        return Pair(f"{self.name} {index} {self.seed}", pixels, pixels[..., 0], np.eye(3))

    def reseeded(self, seed) -> Numbered:
        return Numbered(self.name, self.count, seed)


def test_passes_alternate_and_the_generated_set_is_capped() -> None:
    stream = Stream(Numbered("real", 6), Numbered("made", 50), 3, 32)
    names = [stream.pair(n).name.split(" ", 2) for n in range(24)]
    assert [source for source, *_ in names] == (["real"] * 6 + ["made"] * 6) * 2
    first, second = names[:6], names[12:18]
    assert {i for _, i, _ in first} == {i for _, i, _ in second} == {str(i) for i in range(6)}
    assert [i for _, i, _ in first] != [i for _, i, _ in second], "another order"
    assert {s for *_, s in first} == {"(3, 0)"} and {s for *_, s in second} == {"(3, 2)"}, "other draws"
    made, again = ({i for _, i, _ in names[a : a + 6]} for a in (6, 18))
    assert len(made) == 6 and made != again, "another N_T of the generated ones"
    assert [Stream(Numbered("real", 6), Numbered("made", 50), 3, 32).pair(n).name for n in (20, 3)] == [
        stream.pair(20).name,
        stream.pair(3).name,
    ]


def test_processes_share_out_a_batch() -> None:
    alone = list(Steps(2, 5, 4))
    shares = [list(Steps(2, 5, 4, rank, 2)) for rank in range(2)]
    assert alone == [[8, 9, 10, 11], [12, 13, 14, 15], [16, 17, 18, 19]]
    assert [a + b for a, b in zip(*shares, strict=True)] == alone
    with pytest.raises(ValueError, match="training.batch: expected a multiple of 3"):
        Steps(0, 1, 4, 0, 3)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a map and a tiny two-stage experiment over it: 64 px windows, 32 px frames."""
    out = tmp_path_factory.mktemp("train")
    rng = np.random.default_rng(0)
    rgb = sum(cv2.resize(rng.random((n, n, 3)).astype(np.float32), (300, 300)) for n in (6, 25, 80)) * 84 + 2
    profile = {"driver": "GTiff", "width": 300, "height": 300, "count": 3, "dtype": "uint8", "crs": "EPSG:32612"}
    with rasterio.open(out / "m.tif", "w", transform=rasterio.transform.Affine(8, 0, 3e5, 0, -8, 3.9e6), **profile) as file:
        file.write(np.moveaxis(rgb.astype(np.uint8), -1, 0))
    source = 'kind = "maps"\nmaps = ["m.tif"]\nm_per_px = 8.0\nframe_px = 32\n'
    (out / "base.toml").write_text(
        'row = "none: a test"\nwindow_m = 64\nsearch_radius_m = 60\n[network]\nlevels = 2\nresize_width = 32\niterations = 2\n'
        "fine_iterations = 2\nfine_padding = 4\ntwo_stages = true\n[box]\ncentre_px = 6\nwiden_px = 6\n"
        "[training]\nsteps = 4\nbatch = 2\nworkers = 0\nlog_every = 1\nvalidate_every = 2\nsave_every = 2\npicture_every = 4\n"
        f'[noise]\nrotation_deg = 10\n[data]\nroot = "{out}"\n'
        f"[data.train]\naugment = true\ncount = 3\n{source}[data.extended]\ncount = 9\nseed = 5\n{source}"
        f"[data.validation]\ncount = 3\nseed = 9\n{source}"
    )
    (out / "e.toml").write_text('base = "base.toml"\nseed = 4\n[training]\npeak_lr = 1e-3\n')
    return out


@pytest.fixture(scope="module")
def whole(place: Path) -> Path:
    """Four steps without a stop."""
    out = place / "whole"
    assert main([str(place / "e.toml"), "--out", str(out), "--accelerator", "cpu"]) == 0
    return out


def test_a_training_that_stops_and_goes_on_equals_one_that_does_not(place: Path, whole: Path, monkeypatch) -> None:
    stopped = place / "stopped"
    write = saving.write_atomically

    def interrupt(state: dict, path: Path) -> None:
        write(state, path)
        raise KeyboardInterrupt

    words = [str(place / "e.toml"), "--out", str(stopped), "--accelerator", "cpu"]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(saving, "write_atomically", interrupt)
        main(words)
    assert [p.name for p in (stopped / "checkpoints").iterdir()] == ["step-00000002.pt"]
    (stopped / "curve.csv").open("a").write("3,0,0,0,0,0,0,0\n")  # a row after the checkpoint
    assert main(words) == 2, "a folder in use is not overwritten"
    assert main([*words, "--resume"]) == 0
    one, other = (saving.load(out / "checkpoints/step-00000004.pt") for out in (whole, stopped))
    assert one["task"].keys() == other["task"].keys()
    for key, value in one["task"].items():
        assert torch.equal(value, other["task"][key]), key
    for index, state in one["optimiser"]["state"].items():
        assert all(torch.equal(state[k], other["optimiser"]["state"][index][k]) for k in ("step", "exp_avg", "exp_avg_sq"))
    rows = [[row[:1] + row[2:] for row in csv.reader((out / "curve.csv").open())] for out in (whole, stopped)]
    assert rows[0] == rows[1] and len(rows[0]) == 5, "the curve too, but for its seconds"


def test_two_processes_train_as_one_does(place: Path) -> None:
    """Data parallel over gloo, each with a loader's worker: the same pairs a step, so the same curve up to rounding."""
    words = ["-m", "sthn.train", str(place / "e.toml"), "--accelerator", "cpu", "--set", "training.steps=2"]
    words += ["--set", "training.workers=1", "--set", "noise.rotation_deg=0", "--set", 'box.kind="none"']
    for name, more in (("one-process", []), ("two-processes", ["--devices", "2", "--strategy", "ddp"])):
        command = [sys.executable, *words, "--out", str(place / name), *more]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
    for file in ("curve.csv", "validation.csv"):
        one, two = (list(csv.DictReader((place / n / file).open())) for n in ("one-process", "two-processes"))
        assert len(one) == len(two) > 0
        for a, b in zip(one, two, strict=True):
            assert [float(v) for k, v in b.items() if k != "seconds"] == pytest.approx(
                [float(v) for k, v in a.items() if k != "seconds"], rel=1e-3
            )
    assert load_checkpoint(place / "two-processes/best").config == TINY


def test_a_training_may_go_on_from_any_checkpoint(place: Path, whole: Path) -> None:
    words = [str(place / "e.toml"), "--out", str(place / "other"), "--accelerator", "cpu"]
    assert main([*words, "--resume", str(whole / "checkpoints/step-00000002.pt")]) == 0
    one, other = (load_file(out / "final/model.safetensors") for out in (whole, place / "other"))
    assert all(torch.equal(value, other[key]) for key, value in one.items())


def test_checkpoints_are_in_the_released_layouts_and_load_strictly(whole: Path) -> None:
    trained = load_checkpoint(whole / "final")
    assert trained.config == TINY
    other = load_checkpoint(whole / "STHN.pth", TINY)
    assert all(torch.equal(value, other.state_dict()[key]) for key, value in trained.state_dict().items())
    assert load_checkpoint(whole / "best").config == TINY
    with pytest.raises(CheckpointError, match="expected shape"):
        load_checkpoint(whole / "final", dataclasses.replace(TINY, corr_level=1))
    assert (whole / "pictures/step-00000004.jpg").stat().st_size > 1000


def test_the_direction_of_the_look_up_goes_along(tmp_path: Path) -> None:
    """A network of one direction is another one in the other: the folder, evaluation and the start of a training say it."""
    network = Sthn(dataclasses.replace(TINY, two_stages=False), Lookup.FRAME_INDEXED)
    saving.save_released(network, tmp_path / "best")
    saving.save_pth({"netG": network.netG}, tmp_path / "bare.pth")
    assert load_checkpoint(tmp_path / "best").netG.lookup is Lookup.FRAME_INDEXED
    assert Spec.parse(f"checkpoint:{tmp_path}/best").open(50).network.netG.lookup is Lookup.FRAME_INDEXED
    with pytest.raises(CheckpointError, match="lookup: expected frame_indexed, as it was trained, found published"):
        load_checkpoint(tmp_path / "best", lookup=Lookup.PUBLISHED)
    with pytest.raises(CheckpointError, match="lookup: expected published, found frame_indexed"):
        saving.start_from(Sthn(TINY), tmp_path / "best")
    assert load_checkpoint(tmp_path / "bare.pth", network.config).netG.lookup is Lookup.PUBLISHED
    assert (
        load_checkpoint(tmp_path / "bare.pth", network.config, lookup=Lookup.FRAME_INDEXED).netG.lookup.value == "frame_indexed"
    )
    assert Spec.parse("checkpoint:a.pth,window=64,lookup=frame_indexed").options["lookup"] is Lookup.FRAME_INDEXED
    (tmp_path / "experiment.json").write_text('{"network": {"lookup": "map_indexed"}}')
    assert load_checkpoint(tmp_path / "bare.pth", network.config).netG.lookup is Lookup.MAP_INDEXED, "beside its training"


def test_two_stages_start_from_a_coarse_checkpoint(place: Path, whole: Path) -> None:
    torch.manual_seed(8)
    coarse = Sthn(dataclasses.replace(TINY, two_stages=False))
    saving.save_released(coarse, place / "coarse")
    both = Sthn(TINY)
    fresh = {key: value.clone() for key, value in both.state_dict().items()}
    saving.start_from(both, place / "coarse")
    for key, value in both.state_dict().items():
        assert torch.equal(value, fresh[key] if key.startswith("netG_fine.") else coarse.state_dict()[key])
    saving.start_from(both, whole / "STHN.pth")
    assert torch.equal(both.netG_fine.fnet1.conv1.weight, load_checkpoint(whole / "final").netG_fine.fnet1.conv1.weight)
    with pytest.raises(CheckpointError, match="unexpected netG_fine"):
        saving.start_from(coarse, whole / "STHN.pth")


def test_validation_has_no_augmentation_and_metres_are_metres(place: Path, whole: Path) -> None:
    """The identity's MACE over the validation pairs, computed here from their truth, is the file's: nothing moved them,
    and a network pixel is alpha window pixels of 8 m."""
    from sthn.data import open_source

    made = experiment.read(place / "e.toml")
    table = made.source_table("validation")
    assert "noise" not in table and made.source_table("train")["noise"]["rotation_deg"] == 10
    source = open_source(table, root=place)
    wanted = np.mean([8 * np.hypot(*(source[i].centre() - 31.5)) for i in range(3)])  # a shift: every corner's is the centre's
    rows = list(csv.DictReader((whole / "validation.csv").open()))
    assert [row["step"] for row in rows] == ["2", "4"]
    assert [float(row["identity_m"]) for row in rows] == pytest.approx([wanted] * 2, rel=1e-4)
    text = (place / "e.toml").read_text() + "[data.validation]\naugment = true\n"
    (place / "bad.toml").write_text(text)
    with pytest.raises(DataError, match="data.validation: augment: expected false"):
        experiment.read(place / "bad.toml")


def test_the_box_is_not_augmented_in_validation(place: Path, monkeypatch) -> None:
    monkeypatch.setattr(box, "augmented", lambda *_: pytest.fail("augmented outside training"))
    torch.manual_seed(0)
    made = experiment.read(place / "e.toml", ["training.steps=1"])
    fabric = loop.make_fabric("32-true", "cpu")
    source = Numbered("real", 2)
    run = loop.Loop(SthnTask(Sthn(TINY)), made, source, source, None, place / "validate", fabric)
    run.out.mkdir()
    run._validate(0.0)
    assert np.isfinite(run.best_m)


def test_a_training_that_dies_in_validation_has_its_checkpoint_and_validates_first(place: Path, whole: Path, monkeypatch) -> None:
    out = place / "died"
    words = [str(place / "e.toml"), "--out", str(out), "--accelerator", "cpu"]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop.Loop, "_validate", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        main(words)
    assert [p.name for p in (out / "checkpoints").iterdir()] == ["step-00000002.pt"]
    assert main([*words, "--resume"]) == 0
    one, other = (list(csv.DictReader((p / "validation.csv").open())) for p in (whole, out))
    assert [row | {"seconds": ""} for row in one] == [row | {"seconds": ""} for row in other]
    one, other = (load_file(p / "best/model.safetensors") for p in (whole, out))
    assert all(torch.equal(value, other[key]) for key, value in one.items())


def test_a_validation_pair_without_a_finite_answer_is_counted(place: Path) -> None:
    made = experiment.read(place / "e.toml", ["training.steps=1", "training.batch=1"])
    source = Numbered("real", 3)
    run = loop.Loop(SthnTask(Sthn(TINY)), made, source, source, None, place / "counted", loop.make_fabric("32-true", "cpu"))
    run.out.mkdir()
    answers = iter([torch.full((1, 2, 2, 2), value) for value in (1.0, float("nan"), 1.0)])
    run.module = torch.nn.Identity()
    run.module.forward = lambda *_: {"final": next(answers)}
    run._validate(0.0)
    (row,) = csv.reader((run.out / "validation.csv").open())
    # Truth is a frame in the corner of a window as large: every displacement is 0; a network pixel is 2 m.
    assert [float(x) for x in row[2:]] == pytest.approx([0.0, 2 * 2**0.5 * 2 / 3, 2 * 2**0.5 * 2 / 3, 1], abs=1e-4)
    assert (run.out / "best").is_dir()


def test_the_schedule_and_the_optimiser_are_the_published_ones(place: Path, whole: Path) -> None:
    state = saving.load(whole / "checkpoints/step-00000004.pt")["optimiser"]["param_groups"]
    assert len(state) == 1
    group = state[0]
    assert (group["weight_decay"], group["eps"], tuple(group["betas"])) == (1e-5, 1e-8, (0.9, 0.999))
    rates = [float(row["lr"]) for row in csv.DictReader((whole / "curve.csv").open())]
    # Linear from peak / 25 over 5 % of steps + 100, the end of the rise included.
    rise = 0.05 * (4 + 100) - 1
    wanted = [1e-3 / 25 + (1e-3 - 1e-3 / 25) * step / rise for step in range(4)]
    assert rates == pytest.approx(wanted, rel=1e-3)


def test_each_net_is_clipped_apart(place: Path, monkeypatch) -> None:
    made = experiment.read(place / "e.toml", ["training.clip=0.001"])
    source = Numbered("real", 4)
    run = loop.Loop(SthnTask(Sthn(TINY)), made, source, source, None, place / "clip", loop.make_fabric("32-true", "cpu"))
    monkeypatch.setattr(run.optimiser.optimizer, "step", lambda *_, **__: None)
    window, thermal = images(2, 64, 32)
    run._train_step(window, thermal, torch.full((2, 2, 2, 2), 3.0))
    for net in run.task.nets().values():
        norm = torch.stack([p.grad.norm() for p in net.parameters()]).norm().item()
        assert norm == pytest.approx(0.001, rel=1e-2)


def test_a_step_without_finite_gradients_is_left_out(place: Path, monkeypatch) -> None:
    """Three corners in a line: the published code drops such an increment; here the step changes nothing."""
    made = experiment.read(place / "e.toml")
    source = Numbered("real", 4)
    run = loop.Loop(SthnTask(Sthn(TINY)), made, source, source, None, place / "nan", loop.make_fabric("32-true", "cpu"))
    before = {key: value.clone() for key, value in run.task.state_dict().items()}
    truth = torch.full((2, 2, 2, 2), 3.0)
    handle = run.task.network.netG.fnet1.conv1.weight.register_hook(lambda gradient: gradient * float("nan"))
    run._train_step(*images(2, 64, 32), truth)
    assert run.step == 1 and all(torch.equal(value, before[key]) for key, value in run.task.state_dict().items())
    monkeypatch.setattr(loop, "MOST_LEFT_OUT", 2)
    with pytest.raises(loop.TrainingError, match="step 1: expected finite gradients"):
        run._train_step(*images(2, 64, 32), truth)
    handle.remove()
    run._train_step(*images(2, 64, 32), truth)
    assert any(not torch.equal(value, before[key]) for key, value in run.task.state_dict().items())


def test_it_learns_a_batch_by_heart() -> None:
    """Both stages, without augmentation: far below identity within seconds."""
    torch.manual_seed(3)
    task = SthnTask(Sthn(TINY))
    window, thermal = images(2, 64, 32, seed=5)
    truth = torch.tensor([[3.0, -2.0], [-4.0, 1.0]])[:, :, None, None].expand(2, 2, 2, 2)
    optimiser = torch.optim.AdamW(task.parameters(), lr=1e-3)
    for _ in range(40):
        out = task(window, thermal, truth, torch.zeros(2, 3))
        optimiser.zero_grad()
        out["loss"].backward()
        optimiser.step()
    errors = {key: (out[key].detach() - truth).norm(dim=1).mean().item() for key in ("coarse", "final")}
    identity = truth.norm(dim=1).mean().item()
    assert errors["coarse"] < 0.35 * identity and errors["final"] < 0.35 * identity, (identity, errors)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("training.step=1", "training: step: expected one of .*, found an unknown key"),
        ("network.levels=9", "corr_level: expected 1 to 3, found 9"),
        ('box.kind="wide"', r"box.kind: expected none \| widen \| full, found wide"),
        ('training.precision="16-mixed"', r"training.precision: expected 32-true \| bf16-mixed"),
        ("training.batch=0", "training.batch: expected 1 to 4096, found 0"),
        ("seed=one", "expected KEY=VALUE with a TOML value"),
        ("data.train.kind=3", "kind: expected boson"),
    ],
)
def test_a_wrong_key_is_an_error_that_names_it(place: Path, override: str, said: str, capsys) -> None:
    import re

    words = [str(place / "e.toml"), "--out", str(place / "never"), "--accelerator", "cpu", "--set", override]
    assert main(words) == 2
    text = capsys.readouterr().err
    assert re.search(said, text), text


def test_a_source_of_another_kind_replaces_the_one_below(tmp_path: Path) -> None:
    """As experiments/README.md says: `split` of the published data would be an unknown key of maps."""
    file = ROOT / "models/experiments/table-1/ws512-dc64.toml"
    words = ['data.train.kind="maps"', 'data.train.maps=["a.tif"]', "data.train.count=9", 'data.train.maps=["b.tif"]']
    made = experiment.read(file, words)
    assert made.data["train"] == {"kind": "maps", "maps": ["b.tif"], "count": 9}
    assert made.data["validation"] == {"kind": "boson", "split": "val"}
    assert experiment.read(file, ['data.train.kind="boson"']).data["train"]["split"] == "train"
    made = experiment.read(file, ['box.kind="widen"', "box.widen_px=8", 'box.kind="full"'])
    assert (made.box.kind, made.box.widen_px) == ("full", 8), "a source only"


def test_a_base_that_names_itself_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('base = "b.toml"\n')
    (tmp_path / "b.toml").write_text('base = "a.toml"\n')
    with pytest.raises(DataError, match="base: expected at most 8 files, none twice"):
        experiment.read(tmp_path / "a.toml")


NOISES = {"rotation": ("5", "10", "30"), "scale": ("0p1", "0p2", "0p3"), "perspective": ("8", "16", "32")}
NOISE_KEYS = {"rotation": "rotation_deg", "scale": "scale", "perspective": "perspective_px"}
OTHERS = ("rivals", "tgm")
"""Of other commands: `sthn.rivals.train --data`, `sthn.tgm train --data`."""
EXPERIMENTS = sorted(path for path in (ROOT / "models/experiments").glob("*/*.toml") if path.parent.name not in OTHERS)


def test_every_experiment_of_the_paper_has_a_file_that_says_what_its_name_says() -> None:
    made = {f"{path.parent.name}/{path.stem}": experiment.read(path) for path in EXPERIMENTS}
    assert len({one.row for one in made.values()}) == len(made)
    for window, levels in ((512, 2), (1024, 4), (1536, 4)):
        for radius in (50, 64, 128, 256, 512):
            one = made[f"table-1/ws{window}-dc{radius}"]
            assert (one.window_m, one.search_radius_m, one.network.levels) == (window, radius, levels)
            assert not one.network.two_stages and one.config.iters_lev0 == 6 and "extended" in one.data
            if window == 1536:
                two = made[f"table-1/ws{window}-dc{radius}-two-stages"]
                assert two.network.two_stages and two.training.init.endswith(f"dc{radius}/best") and two.box.kind == "full"
                assert (two.search_radius_m, two.config.fine_padding, two.config.iters_lev1) == (radius, 32, 6)
    rows = {f"{kind}-{bound}" for kind, bounds in NOISES.items() for bound in bounds}
    for row in rows:
        kind, bound = row.split("-")
        for stages in ("one-stage", "two-stages"):
            one = made[f"table-3/{row}-{stages}"]
            assert one.data["validation"]["noise"] == {NOISE_KEYS[kind]: float(bound.replace("p", ".")), "kind": kind}
            assert (one.noise.rotation_deg, one.noise.scale, one.noise.perspective_px) == (30, 0.3, 16)
    assert {made[f"ablations/box-{kind}"].box.kind for kind in ("none", "widen", "full")} == {"none", "widen", "full"}
    assert made["ablations/box-paper"].box.rule == "paper"
    assert all("extended" not in made[f"ablations/without-tgm-ws512-dc{radius}"].data for radius in (50, 64, 128, 256, 512))


def published(folder: Path) -> Path:
    """A data set in the published layout, of a few frames."""
    from sthn.data import boson

    folder.mkdir(parents=True)
    pixels = np.random.default_rng(0).integers(1, 255, (700, 760, 3), dtype=np.uint8)
    (folder.parent / boson.MAP_NAME).parent.mkdir(parents=True)
    cv2.imwrite(str(folder.parent / boson.MAP_NAME), pixels)
    for split in ("train", "val", "extended"):
        name = "extended_queries_test_excluded" if split == "extended" else f"{split}_queries"
        boson.write(folder / f"{name}.h5", [pixels[:512, :512, 0]] * 2, [(300, 330), (340, 400)])
        boson.write(folder / f"{split}_database.h5", [np.zeros((4, 4), np.uint8)] * 2, [(310, 330), (345, 390)])
    return folder


def test_the_rivals_and_the_tgm_train_on_the_published_layout(tmp_path: Path) -> None:
    """The committed files as they are, but for sizes."""
    from sthn.rivals import train as rivals
    from sthn.tgm.__main__ import main as tgm

    files = {path.name: path for name in OTHERS for path in (ROOT / "models/experiments" / name).glob("*.toml")}
    assert len(files) == 6
    for radius in (50, 64, 128, 256, 512):
        source, table = rivals.read_tables(files[f"table-1-dc{radius}.toml"])
        assert (source["window_m"], source["search_radius_m"], table["batch"]) == (512, radius, 16)
    root = published(tmp_path / source["folder"]).parent
    words = ["ihn", "--data", str(files["table-1-dc512.toml"]), "--root", str(root), "--out", str(tmp_path / "ihn")]
    assert rivals.main([*words, "--steps", "1", "--batch", "2", "--side-px", "32"]) == 0
    facts = json.loads((tmp_path / "ihn/training.json").read_text())
    assert (facts["peak"], facts["batch"], facts["search_radius_m"]) == (1e-4, 2, 512)
    words = "train --size-px 32 --downs 5 --ngf 4 --ndf 4 --batch 2 --epochs 1 --decay-epochs 0 --steps-per-epoch 1".split()
    words += ["--data", str(files["boson.toml"]), "--root", str(root), "--out", str(tmp_path / "tgm")]
    assert tgm(words) == 0 and (tmp_path / "tgm/best_model.pth").is_file()


def test_an_experiment_of_the_paper_trains_on_the_published_layout(tmp_path: Path) -> None:
    """The committed file as it is, but for sizes: files in the released layout in, a checkpoint out."""
    folder = published(tmp_path / "data" / "v3")
    small = ["network.resize_width=32", "network.iterations=1", "training.steps=1", "training.batch=2", "training.workers=0"]
    words = [str(ROOT / "models/experiments/table-1/ws512-dc64.toml"), "--out", str(tmp_path / "run"), "--accelerator", "cpu"]
    for override in [f'data.root="{folder.parent}"', 'data.folder="v3"', *small]:
        words += ["--set", override]
    assert main(words) == 0
    assert load_checkpoint(tmp_path / "run/final").config.database_size == 512
    (folder / "extended_queries_test_excluded.h5").rename(folder / "extended_queries.h5")
    words[2] = str(tmp_path / "refused")
    assert main(words) == 2, "the extended set with the test region"
    assert main([*words, "--set", "data.extended=false"]) == 0
