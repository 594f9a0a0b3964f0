"""The training loop: AdamW, a one-cycle schedule, each net's gradient clipped apart; on CPU, one GPU or several.

Everything random is a function of the seed and the step (`stream.py`, `box.py`), so that a checkpoint holds no state of a
generator, and a training that goes on equals one that never stopped.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from tqdm import tqdm

from .. import geometry
from ..data.pair import Pair, PairSource, TrainingSource
from . import box, pictures, saving
from .experiment import Experiment
from .stream import Fixed, Steps, Stream, loader

SCHEDULE_SPARE = 100
"""The published schedule is that much longer than the training."""

SHEET_PAIRS = 4

MOST_LEFT_OUT = 50
"""Steps in a row without finite gradients after which a training has failed."""

CURVE = ("step", "seconds", "lr", "loss", "loss_coarse", "loss_fine", "mace_coarse_m", "mace_m")
VALIDATION = ("step", "seconds", "identity_m", "mace_coarse_m", "mace_m", "not_finite")
"""Of all validation pairs; the last: how many had no finite answer. Those count as the identity's."""


class TrainingError(ValueError):
    """A training that cannot go on."""


class Loop:
    """A training in a folder. `task`: see `task.Task`; `m_per_px`: of the windows, for curves in metres."""

    def __init__(
        self,
        task: nn.Module,
        experiment: Experiment,
        train: TrainingSource,
        validation: PairSource,
        extended: TrainingSource | None,
        out: Path,
        fabric: Fabric,
    ) -> None:
        self.experiment, self.out, self.fabric = experiment, Path(out), fabric
        self.table = experiment.training
        self.task = task
        self.side_px = experiment.network.resize_width
        self.stream = Stream(train, extended, experiment.seed, self.side_px)
        self.validation = Fixed(validation, self.side_px)
        first = validation[0]
        self.m_per_network_px = first.m_per_px * first.window_m / self.side_px
        self.identity = torch.from_numpy(_centred(first, self.side_px)).float()
        optimiser = torch.optim.AdamW(
            task.parameters(), lr=self.table.peak_lr, weight_decay=self.table.weight_decay, eps=self.table.eps
        )
        self.module, self.optimiser = fabric.setup(task, optimiser)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser.optimizer,
            max_lr=self.table.peak_lr,
            total_steps=self.table.steps + SCHEDULE_SPARE,
            pct_start=self.table.warm_up,
            cycle_momentum=False,
            anneal_strategy="linear",
        )
        self.step, self.spent_s, self.best_m, self.left_out = 0, 0.0, float("inf"), 0

    def resume(self, path: Path) -> None:
        """Goes on from a checkpoint."""
        state = saving.load(path)
        self.task.load_state_dict(state["task"])
        self.optimiser.optimizer.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        self.step, self.spent_s = state["step"], state["spent_s"]

    def _state(self, seconds: float) -> dict[str, Any]:
        return {
            "task": self.task.state_dict(),
            "optimiser": self.optimiser.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "step": self.step,
            "spent_s": seconds,
        }

    def run(self) -> None:
        """Trains to the end."""
        chief = self.fabric.is_global_zero
        if chief:
            self.out.mkdir(parents=True, exist_ok=True)
            text = json.dumps(dataclasses.asdict(self.experiment), indent=2)
            (self.out / "experiment.json").write_text(text + "\n", encoding="utf-8")
            _keep_rows(self.out / "curve.csv", CURVE, self.step)
            # The best is that of the file, as `best/` is: a checkpoint is written before its validation.
            rows = _keep_rows(self.out / "validation.csv", VALIDATION, self.step)
            self.best_m = min((float(row["mace_m"]) for row in rows), default=self.best_m)
            missed = self._due("validate_every") and not any(int(row["step"]) == self.step for row in rows)
        else:
            missed = False
        self.best_m, missed = self.fabric.broadcast((self.best_m, missed))
        if missed:
            self._validate(self.spent_s)
        steps = Steps(self.step, self.table.steps, self.table.batch, self.fabric.global_rank, self.fabric.world_size)
        batches = loader(self.stream, steps, self.table.workers)
        batches = self.fabric.setup_dataloaders(batches, use_distributed_sampler=False)
        began, sums, counted = time.monotonic(), dict.fromkeys(CURVE[3:], 0.0), 0
        bar = tqdm(total=self.table.steps, initial=self.step, mininterval=2, file=sys.stderr, disable=None if chief else True)
        with bar:
            for window, thermal, truth in batches:
                lr = self.schedule.get_last_lr()[0]
                found = self._train_step(window, thermal, truth)
                bar.update()
                if torch.isfinite(found["loss"]):
                    for key, value in self._columns(found, truth).items():
                        sums[key] += value
                    counted += 1
                seconds = self.spent_s + time.monotonic() - began
                if self._due("log_every"):
                    means = torch.tensor([value / max(counted, 1) for value in sums.values()], dtype=torch.float64)
                    row = dict(zip(sums, self.fabric.all_reduce(means).tolist(), strict=True))
                    bar.set_postfix(mace_m=f"{row['mace_m']:.2f}")
                    if chief:
                        _append(self.out / "curve.csv", [self.step, f"{seconds:.1f}", f"{lr:.4g}", *_numbers(row.values())])
                    sums, counted = dict.fromkeys(sums, 0.0), 0
                if chief and self._due("save_every"):
                    saving.write_atomically(self._state(seconds), self.out / f"checkpoints/step-{self.step:08}.pt")
                if self._due("validate_every"):
                    self._validate(seconds)
                if chief and self._due("picture_every"):
                    self._picture()
        if chief:
            self._release("final")
            saving.save_pth(self.task.nets(), self.out / "STHN.pth")

    def _due(self, every: str) -> bool:
        """Whether something is done after this step: every so many, and after the last."""
        return self.step > 0 and (self.step % getattr(self.table, every) == 0 or self.step == self.table.steps)

    def _train_step(self, window: Tensor, thermal: Tensor, truth: Tensor) -> dict[str, Tensor]:
        self.module.train()
        # One generator a step and process: nothing of it has to be kept.
        words = np.random.SeedSequence([self.experiment.seed, self.step, self.fabric.global_rank, 2])
        generator = torch.Generator().manual_seed(int(words.generate_state(1, np.uint64)[0] >> 1))
        drawn = box.draw(self.experiment.box, window.shape[0], generator).to(truth.device)
        found = self.module(window, thermal, truth, drawn)
        self.optimiser.zero_grad()
        self.fabric.backward(found["loss"])
        norms = [nn.utils.clip_grad_norm_(net.parameters(), self.table.clip) for net in self.task.nets().values()]
        # Three corners in a line give a homography that is not finite. Gradients are already those of all processes, so
        # that all of them leave the step out together.
        if torch.isfinite(torch.stack(norms)).all():
            self.optimiser.step()
            self.left_out = 0
        else:
            self.left_out += 1
            if self.left_out >= MOST_LEFT_OUT:
                raise TrainingError(f"step {self.step}: expected finite gradients, found none in {self.left_out} steps")
        self.schedule.step()
        self.step += 1
        return found

    def _columns(self, found: dict[str, Tensor], truth: Tensor) -> dict[str, float]:
        """What the curve tells of a batch: losses in network px, MACE in metres."""
        losses = {key: found[key].item() for key in ("loss", "loss_coarse", "loss_fine") if key in found}
        final = self._mace_m(found["final"], truth)
        coarse = self._mace_m(found["coarse"], truth) if "coarse" in found else final
        return losses | {"mace_m": final.mean().item(), "mace_coarse_m": coarse.mean().item()}

    def _mace_m(self, displacement: Tensor, truth: Tensor) -> Tensor:
        """Mean distance of the four corners, metres, `[B]`: network px times alpha."""
        return (displacement.detach() - truth).norm(dim=1).flatten(1).mean(1) * self.m_per_network_px

    @torch.no_grad()
    def _validate(self, seconds: float) -> None:
        """MACE on the validation pairs, without any augmentation; the best one so far is released."""
        self.module.eval()
        rank, world = self.fabric.global_rank, self.fabric.world_size
        mine = list(range(rank, len(self.validation), world))
        size = max(1, self.table.batch // world)
        chunks = [mine[i : i + size] for i in range(0, len(mine), size)]
        sums = torch.zeros(5, dtype=torch.float64)
        batches = self.fabric.setup_dataloaders(
            loader(self.validation, chunks, self.table.workers), use_distributed_sampler=False
        )
        for window, thermal, truth in batches:
            found = self.module(window, thermal, truth)
            values = [self.identity.to(truth.device), found.get("coarse", found["final"]), found["final"]]
            errors = torch.stack([self._mace_m(v, truth) for v in values]).double().cpu()
            finite = torch.isfinite(errors)
            sums[:3] += torch.where(finite, errors, errors[:1]).sum(1)
            sums[3:] += torch.tensor([(~finite[2]).sum(), len(truth)])
        sums = self.fabric.all_reduce(sums, reduce_op="sum").cpu()
        means = _numbers((sums[:3] / sums[4]).tolist())
        found_m = float(means[2])
        if self.fabric.is_global_zero:
            if found_m < self.best_m:
                self._release("best")
            _append(self.out / "validation.csv", [self.step, f"{seconds:.1f}", *means, int(sums[3])])
        self.best_m = min(self.best_m, found_m)

    @torch.no_grad()
    def _picture(self) -> None:
        """A sheet of the first validation pairs."""
        self.task.eval()
        source, panels = self.validation.source, []
        for index in range(min(SHEET_PAIRS, len(source))):
            pair = source[index]
            one = [t[None].to(self.fabric.device) for t in self.validation[index]]
            found = self.task(*one)
            quads = [(pair.quad(), pictures.GREEN)]
            for key, colour in (("coarse", pictures.BLUE), ("final", pictures.RED)):
                if key in found:
                    corners = geometry.displaced(self.side_px, found[key][0].double().cpu().numpy())
                    quads.append((geometry.edges_of_inclusive(corners, pair.window_m / self.side_px), colour))
            panels.append(pictures.panel(pair.satellite, pair.thermal, quads))
        pictures.sheet(self.out / f"pictures/step-{self.step:08}.jpg", panels)

    def _release(self, name: str) -> None:
        network = getattr(self.task, "network", None)
        if network is not None:
            saving.save_released(network, self.out / name)
        else:
            saving.write_atomically({key: net.state_dict() for key, net in self.task.nets().items()}, self.out / f"{name}.pth")


def _centred(pair: Pair, side_px: int) -> np.ndarray:
    """The displacement of a frame in the window's middle: what knows nothing answers."""
    frame_px = pair.thermal.shape[0]
    edges = geometry.edge_corners(frame_px) + (pair.window_m - frame_px) / 2
    return geometry.displacement_of(side_px, geometry.inclusive_of_edges(edges, pair.window_m / side_px))


def make_fabric(precision: str, accelerator: str = "auto", devices: str | int = 1, strategy: str = "auto") -> Fabric:
    """Fabric, started. Several devices: data parallel, every process with its share of each batch."""
    # Deterministic matrix products on CUDA need this before the first of them.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    fabric = Fabric(accelerator=accelerator, devices=devices, strategy=strategy, precision=precision)
    fabric.launch()
    return fabric


def _numbers(values: Any) -> list[str]:
    return [f"{value:.5f}" for value in values]


def _append(path: Path, row: list[Any]) -> None:
    with path.open("a", newline="", encoding="utf-8") as file:
        csv.writer(file).writerow(row)


def _keep_rows(path: Path, columns: tuple[str, ...], step: int) -> list[dict[str, str]]:
    """The head and the rows up to `step`: what a stopped run wrote after its checkpoint is written again."""
    lines = path.read_text(encoding="utf-8").splitlines()[1:] if path.exists() and step else []
    kept = [line for line in lines if int(line.split(",")[0]) <= step]
    path.write_text("\n".join([",".join(columns), *kept]) + "\n", encoding="utf-8")
    return [dict(zip(columns, line.split(","), strict=False)) for line in kept]
