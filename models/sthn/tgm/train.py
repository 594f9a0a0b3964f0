"""Training of the TGM: least-squares GAN with 100 x L1, as published.

Loss of D: half the sum of (D(s, t) - 1)^2 and D(s, G(s))^2; of G: (D(s, G(s)) - 1)^2 + 100 |G(s) - t|. Adam 2e-4,
betas 0.5 and 0.999; the rate falls linearly to zero over the second half of the epochs. A step is D's, then G's.
"""

from __future__ import annotations

import csv
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from . import checkpoint
from .networks import DOWNS, NDF, NGF, Discriminator, Generator
from .pairs import to_pixels

COLUMNS = ("epoch", "step", "seconds", "rate", "loss_d", "loss_g_gan", "l1", "val_l1", "val_psnr_db")


@dataclass(frozen=True)
class Recipe:
    """Every number of a training. The defaults are the published ones."""

    size_px: int = 512
    width_m: float = 512.0
    """Ground that the square covers."""
    downs: int = DOWNS
    ngf: int = NGF
    ndf: int = NDF
    epochs: int = 40
    decay_epochs: int = 20
    """Last epochs, over which the rate falls to zero."""
    steps_per_epoch: int | None = None
    """None: one pass over the pairs."""
    batch: int = 32
    rate: float = 2e-4
    l1_weight: float = 100.0
    seed: int = 0

    def check(self, pairs: int) -> None:
        """Raises TgmError where the numbers do not go together."""
        if self.size_px % 2**self.downs or self.size_px < 32:
            raise checkpoint.TgmError(f"size_px: expected a multiple of 2^downs = {2**self.downs}, found {self.size_px}")
        if pairs < self.batch:
            raise checkpoint.TgmError(f"pairs: expected at least one batch of {self.batch}, found {pairs}")
        if not 0 <= self.decay_epochs <= self.epochs:
            raise checkpoint.TgmError(f"decay_epochs: expected 0 to {self.epochs}, found {self.decay_epochs}")


def rate_of(recipe: Recipe, epoch: int) -> float:
    """Learning rate of an epoch, counted from 0."""
    over = max(0, epoch + 1 - (recipe.epochs - recipe.decay_epochs))
    return recipe.rate * (1 - over / (recipe.decay_epochs + 1))


def batches(recipe: Recipe, pairs: int, epoch: int) -> list[list[int]]:
    """Indices of an epoch's batches: a permutation by seed and epoch, repeated as often as the steps need."""
    rng = np.random.default_rng([recipe.seed, epoch])
    steps = recipe.steps_per_epoch or pairs // recipe.batch
    order: list[int] = []
    while len(order) < steps * recipe.batch:
        order += rng.permutation(pairs).tolist()
    return [order[i * recipe.batch : (i + 1) * recipe.batch] for i in range(steps)]


class Trainer:
    """Both networks with their optimisers; resumable after every epoch."""

    def __init__(self, recipe: Recipe, device: str = "cpu") -> None:
        self.recipe, self.device = recipe, device
        torch.manual_seed(recipe.seed)
        self.generator = Generator(recipe.downs, recipe.ngf).to(device)
        self.discriminator = Discriminator(recipe.ndf).to(device)
        self.optimisers = {
            name: torch.optim.Adam(net.parameters(), lr=recipe.rate, betas=(0.5, 0.999))
            for name, net in (("netG", self.generator), ("netD", self.discriminator))
        }
        self.epoch, self.step, self.spent_s, self.best_psnr_db = 0, 0, 0.0, -np.inf

    def resume(self, path: Path) -> None:
        """Goes on from a checkpoint of the same recipe."""
        document = checkpoint.read(path)
        kept = document.get("training")
        if not isinstance(kept, dict):
            raise checkpoint.TgmError(f"{path}: training: missing; only a checkpoint of this command can be resumed")
        wanted = asdict(self.recipe)
        for key, value in wanted.items():
            if kept["recipe"].get(key) != value:
                raise checkpoint.TgmError(f"{path}: training.recipe.{key}: expected {value}, found {kept['recipe'].get(key)}")
        for net, field in ((self.generator, checkpoint.GENERATOR), (self.discriminator, checkpoint.DISCRIMINATOR)):
            state = checkpoint.plain(document.get(field), str(path), field)
            checkpoint.load_strictly(net, state, str(path), field)
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(document[f"optimizer_{name}_state_dict"])
        self.epoch, self.step = document["epoch_num"] + 1, kept["step"]
        self.spent_s, self.best_psnr_db = kept["spent_s"], kept["best_psnr_db"]

    def update(self, satellite: Tensor, thermal: Tensor) -> dict[str, float]:
        """One step of D, then one of G."""
        painted = self.generator(satellite)
        self.discriminator.requires_grad_(True)
        self.optimisers["netD"].zero_grad()
        of_painted, of_real = self.discriminator(satellite, painted.detach()), self.discriminator(satellite, thermal)
        loss_d = 0.5 * ((of_real - 1).square().mean() + of_painted.square().mean())
        loss_d.backward()
        self.optimisers["netD"].step()
        self.discriminator.requires_grad_(False)
        self.optimisers["netG"].zero_grad()
        loss_gan = (self.discriminator(satellite, painted) - 1).square().mean()
        l1 = (painted - thermal).abs().mean()
        (loss_gan + self.recipe.l1_weight * l1).backward()
        self.optimisers["netG"].step()
        return {"loss_d": loss_d.item(), "loss_g_gan": loss_gan.item(), "l1": l1.item()}

    @torch.no_grad()
    def validate(self, pairs: Dataset) -> dict[str, float]:
        """L1 (of -1..1) and PSNR (of 0..255, mean over frames) of the clamped output, norms in evaluation mode."""
        self.generator.eval()
        l1, psnr = [], []
        for satellite, thermal in DataLoader(pairs, self.recipe.batch):
            painted = self.generator(satellite.to(self.device)).clamp(-1, 1).cpu()
            l1 += (painted - thermal).abs().mean((1, 2, 3)).tolist()
            error = ((painted - thermal) * 127.5).square().mean((1, 2, 3)).clamp(min=1e-6)
            psnr += (10 * torch.log10(255**2 / error)).tolist()
        self.generator.train()
        return {"val_l1": float(np.mean(l1)), "val_psnr_db": float(np.mean(psnr))}

    def save(self, path: Path) -> None:
        """The last finished epoch."""
        training = {"recipe": asdict(self.recipe), "step": self.step, "spent_s": self.spent_s, "best_psnr_db": self.best_psnr_db}
        checkpoint.save(path, self.epoch - 1, self.generator, self.discriminator, self.optimisers, training)


def sheet(trainer: Trainer, pairs: Dataset, path: Path, rows: int = 4) -> None:
    """A picture: satellite, real thermal, painted thermal, a pair a row, two pairs side by side."""
    trainer.generator.eval()
    shown = []
    for index in range(min(2 * rows, len(pairs))):
        satellite, thermal = pairs[index]
        with torch.no_grad():
            painted = trainer.generator(satellite[None].to(trainer.device)).cpu()[0]
        grays = [np.repeat(to_pixels(x)[0][..., None], 3, 2) for x in (thermal, painted)]
        shown.append(np.concatenate([np.moveaxis(to_pixels(satellite), 0, -1)[..., ::-1], *grays], 1))
    trainer.generator.train()
    half = max(1, len(shown) // 2)
    picture = np.concatenate([np.concatenate(shown[:half], 0), np.concatenate(shown[half : 2 * half] or shown[:half], 0)], 1)
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])


def train(
    recipe: Recipe,
    training: Dataset,
    validation: Dataset,
    out: Path,
    device: str = "cpu",
    workers: int = 0,
    pictures: int = 5,
) -> Trainer:
    """Runs, or goes on with, a training: `last_model.pth` after every epoch, `best_model.pth` by validation PSNR,
    `curve.csv`, a sheet of samples every `pictures` epochs."""
    recipe.check(len(training))
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(recipe, device)
    last, curve = out / "last_model.pth", out / "curve.csv"
    if last.exists():
        trainer.resume(last)
    # Rows that a stopped run wrote after its last checkpoint are written again.
    _, *rows = curve.read_text().splitlines() if curve.exists() else [""]
    kept = [row for row in rows if int(row.split(",")[0]) <= trainer.epoch]
    curve.write_text("\n".join([",".join(COLUMNS), *kept]) + "\n")
    for epoch in range(trainer.epoch, recipe.epochs):
        began, sums = time.monotonic(), {"loss_d": 0.0, "loss_g_gan": 0.0, "l1": 0.0}
        for optimiser in trainer.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = rate_of(recipe, epoch)
        plan = batches(recipe, len(training), epoch)
        loader = DataLoader(training, batch_sampler=plan, num_workers=workers)
        bar = tqdm(loader, f"epoch {epoch + 1}/{recipe.epochs}", mininterval=5, file=sys.stderr)
        for satellite, thermal in bar:
            for key, value in trainer.update(satellite.to(device), thermal.to(device)).items():
                sums[key] += value / len(plan)
            trainer.step += 1
        seen = trainer.validate(validation)
        trainer.epoch = epoch + 1
        trainer.spent_s += time.monotonic() - began
        numbers = {"rate": rate_of(recipe, epoch), **sums, **seen}
        with curve.open("a") as file:
            row = [trainer.epoch, trainer.step, round(trainer.spent_s), *(f"{numbers[key]:.5g}" for key in COLUMNS[3:])]
            csv.writer(file, lineterminator="\n").writerow(row)
        best = seen["val_psnr_db"] > trainer.best_psnr_db
        trainer.best_psnr_db = max(trainer.best_psnr_db, seen["val_psnr_db"])
        trainer.save(last)
        if best:
            trainer.save(out / "best_model.pth")
        if trainer.epoch % pictures == 0 or trainer.epoch == recipe.epochs:
            sheet(trainer, validation, out / f"samples-{trainer.epoch:03d}.jpg")
    return trainer
