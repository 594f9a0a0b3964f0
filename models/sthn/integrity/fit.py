"""Fits the calibrated model on trials and puts it into the bundle.

    python -m sthn.integrity.fit --trials target/integrity/calibration.csv --bundle models/bundles/lite-1536

A logistic regression over the cues gives a score; a monotone curve turns it into the probability of an error above 25 m. That
is conditional on no more than what the aircraft knows: the frame is over the place that the prior says, or it is not. The base
rate is therefore a decision: `OWN_SHARE` of the weight is that of frames over their own place, whatever their number among the
trials.

The curve is fitted on scores from outside the fold (the score of a trial comes from weights that no trial over the same map had
a part in). Logistic (Platt), isotonic regression, or their mean: the one with the least log loss over maps left out. Whichever
it is, the bundle keeps `KNOTS` points of it. Reference: Platt, Probabilistic outputs for support vector machines, 1999.

The match error of what is right is Gaussian with `ln sigma` linear in the cues, by maximum likelihood. Only trials with gates
off serve, over maps that training did not see.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import isotonic_regression, minimize

from .. import manifest as manifest_rules
from . import model
from .trials import whole_command

BOUND_M = 25.0
GAUSSIAN_TAIL999 = 3.7169
TAIL_MARGIN = 1.1
"""What the tail seen on the calibration's frames is widened by: they are few for one in a thousand."""

OWN = ("localisable", "water")
"""Categories of frames over the place that their prior says."""
OWN_SHARE = 0.8
"""Base rate: share of the weight of such frames, in the fit of the curve and in the report of it. The others are elsewhere, or of
nothing (shutter, blank, noise)."""

KNOTS = 13
"""Points of the curve that the bundle keeps."""
CURVES = ("logistic", "mean", "isotonic")

CUES = {
    "peak_mass": "logit",
    "second_peak": "log",
    "entropy_bits": "linear",
    "peak_logit": "linear",
    "cycle_m": "log",
    "cycle_mass": "logit",
    "stage_shift_m": "log",
    "refine_residual_m": "log",
    "refine_weight": "log",
    "refine_match_sigma_m": "log",
    "refine_last_step_m": "log",
    "crop_spread_m": "log",
    "crop_middle_spread_m": "log",
    "gradient_agreement": "linear",
    "quad_side_ratio": "linear",
    "frame_smoothness": "linear",
}
"""Cues of the model and their transforms."""
SIGMA_CUES = ("refine_residual_m", "refine_weight", "refine_match_sigma_m", "crop_middle_spread_m", "gradient_agreement")
"""Cues of the match error."""


def read_trials(path: Path) -> dict[str, np.ndarray]:
    """Columns of a table of trials; texts stay texts."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise SystemExit(f"{path}: expected rows, found none")
    texts = {"flight", "file", "map", "category", "status", "reason"}
    return {
        name: np.array([row[name] for row in rows])
        if name in texts
        else np.array([float(row[name]) if row[name] else np.nan for row in rows])
        for name in rows[0]
    }


def evidence_of(trials: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The evidence's columns by their names in the message."""
    return {name[2:]: column for name, column in trials.items() if name.startswith("e.")}


def fit_score(x: np.ndarray, wrong: np.ndarray, weight: np.ndarray, ridge: float = 3.0) -> tuple[np.ndarray, float]:
    """Logistic regression on standardised columns with a ridge: weights and bias for the columns as they are."""
    mean, std = x.mean(0), x.std(0) + 1e-9
    z = (x - mean) / std

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        logit = z @ parameters[:-1] + parameters[-1]
        value = (weight * (np.logaddexp(0, logit) - wrong * logit)).sum() + 0.5 * ridge * (parameters[:-1] ** 2).sum()
        slope = weight * (1 / (1 + np.exp(-logit)) - wrong)
        return value, np.append(z.T @ slope + ridge * parameters[:-1], slope.sum())

    found = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, method="L-BFGS-B", options={"maxiter": 2000})
    weights = found.x[:-1] / std
    return weights, float(found.x[-1] - weights @ mean)


def trial_weight(category: np.ndarray) -> np.ndarray:
    """Weight of each trial, 1 in the mean: own places have `OWN_SHARE` of it (all of it where there is nothing else)."""
    own = np.isin(category, OWN)
    share = OWN_SHARE if own.any() and not own.all() else float(own.any())
    return len(own) * np.where(own, share / max(1, own.sum()), (1 - share) / max(1, (~own).sum()))


def scores_left_out(x: np.ndarray, wrong: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Every trial's score by weights fitted over the other maps; right and wrong weigh the same."""
    score = np.full(len(x), np.nan)
    for name in np.unique(maps):
        out = maps == name
        if wrong[~out].all() or not wrong[~out].any():
            raise SystemExit(f"trials: expected right and wrong answers over other maps than {name}, found one kind only")
        weights, bias = fit_score(x[~out], wrong[~out], balanced(wrong[~out]))
        score[out] = bias + x[out] @ weights
    return score


def balanced(wrong: np.ndarray) -> np.ndarray:
    """Weights by which right and wrong weigh the same."""
    return np.where(wrong, 0.5 / wrong.mean(), 0.5 / (~wrong).mean())


def fit_logistic(score: np.ndarray, wrong: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Slope (not negative) and offset of the logit over the score, by maximum likelihood. The targets are Platt's: what was
    seen n times without exception has a probability of 1 / (n + 2), not 0."""
    high, low = (wrong.sum() + 1) / (wrong.sum() + 2), 1 / ((~wrong).sum() + 2)
    target = np.where(wrong, high, low)
    middle, width = float(np.average(score, weights=weight)), float(score.std()) + 1e-9
    z = (score - middle) / width

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        logit = parameters[0] * z + parameters[1]
        slope = weight * (sigmoid(logit) - target)
        return float((weight * (np.logaddexp(0, logit) - target * logit)).sum()), np.array([slope @ z, slope.sum()])

    found = minimize(loss, np.array([1.0, 0.0]), jac=True, method="L-BFGS-B", bounds=[(1e-6, None), (None, None)])
    slope = float(found.x[0]) / width
    return slope, float(found.x[1]) - slope * middle


def sigmoid(logit: np.ndarray) -> np.ndarray:
    """Logistic function."""
    return 0.5 * (1 + np.tanh(0.5 * logit))


def isotonic_steps(score: np.ndarray, wrong: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Isotonic regression; each step's probability with half a count added on both sides, so that none is 0 or 1."""
    order = np.argsort(score, kind="stable")
    score, wrong, weight = score[order], wrong[order].astype(float), weight[order]
    blocks = isotonic_regression(wrong, weights=weight).blocks
    curve: dict[float, float] = {}
    for begin, end in zip(blocks, blocks[1:], strict=False):
        part = slice(begin, end)
        value = (weight[part] @ wrong[part] + 0.5) / (weight[part].sum() + 1.0)
        curve |= {float(score[begin]): value, float(score[end - 1]): value}
    return np.array(list(curve)), np.maximum.accumulate(list(curve.values()))


def curve_knots(kind: str, score: np.ndarray, wrong: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scores and probabilities at `KNOTS` points of a curve: evenly over where the logistic one is neither 0 nor 1 for these
    trials. No probability is more certain than they allow."""
    slope, offset = fit_logistic(score, wrong, weight)
    least, most = 0.5 / ((~wrong).sum() + 1.0), 1 - 0.5 / (wrong.sum() + 1.0)
    ends = (np.log([least / (1 - least), most / (1 - most)]) - offset) / slope
    ends = np.clip(ends, score.min() - 1e-3, score.max() + 1e-3)
    at = np.round(np.linspace(*ends, KNOTS), 6)
    logistic = sigmoid(offset + slope * at)
    isotonic = np.interp(at, *isotonic_steps(score, wrong, weight))
    p = {"logistic": logistic, "isotonic": isotonic, "mean": (logistic + isotonic) / 2}[kind]
    return at, np.round(np.maximum.accumulate(np.clip(p, least, most)), 6)


def log_loss(p: np.ndarray, wrong: np.ndarray, weight: np.ndarray) -> float:
    """Mean, in nats."""
    return float(-np.average(np.log(np.where(wrong, p, 1 - p)), weights=weight))


def choose_curve(score: np.ndarray, wrong: np.ndarray, weight: np.ndarray, maps: np.ndarray) -> tuple[str, dict[str, float]]:
    """The kind of curve with the least log loss over maps left out, and the losses. At a tie the first of `CURVES`."""
    losses = {}
    for kind in CURVES:
        p = np.full(len(score), np.nan)
        for name in np.unique(maps):
            out = maps == name
            p[out] = np.interp(score[out], *curve_knots(kind, score[~out], wrong[~out], weight[~out]))
        losses[kind] = round(log_loss(p, wrong, weight), 6)
    return min(CURVES, key=lambda kind: losses[kind]), losses


def fit_sigma(x: np.ndarray, error_m: np.ndarray, ridge: float = 3.0) -> tuple[np.ndarray, float]:
    """Weights and bias of ln sigma: an isotropic Gaussian by maximum likelihood, with a ridge."""
    mean, std = x.mean(0), x.std(0) + 1e-9
    z = (x - mean) / std

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        ln_sigma = z @ parameters[:-1] + parameters[-1]
        squares = 0.5 * error_m**2 * np.exp(-2 * ln_sigma)
        value = (2 * ln_sigma + squares).sum() + 0.5 * ridge * (parameters[:-1] ** 2).sum()
        slope = 2 - 2 * squares
        return value, np.append(z.T @ slope + ridge * parameters[:-1], slope.sum())

    start = np.append(np.zeros(x.shape[1]), 0.5 * np.log((error_m**2).mean() / 2))
    found = minimize(loss, start, jac=True, method="L-BFGS-B")
    weights = found.x[:-1] / std
    return weights, float(found.x[-1] - weights @ mean)


def fit(trials: dict[str, np.ndarray], data: str, command: str, accept: float) -> dict[str, Any]:
    """The `[integrity]` table. `accept`: the gate for which sigma is fitted."""
    evidence = evidence_of(trials)
    usable = (trials["status"] == "fix") & np.all([np.isfinite(evidence[name]) for name in CUES], 0)
    trials = {name: column[usable] for name, column in trials.items()}
    evidence = evidence_of(trials)
    wrong = ~(trials["error_m"] <= BOUND_M)
    if wrong.all() or not wrong.any():
        raise SystemExit("trials: expected right and wrong answers, found one kind only")
    maps = trials.get("map", np.array([]))
    if len(np.unique(maps)) < 2:
        raise SystemExit("trials: expected a column `map` with at least two maps, to leave one out")
    table: dict[str, Any] = {"data": data, "command": command, "trials": int(usable.sum()), "bound_m": BOUND_M}
    table["cues"] = []
    for name, kind in CUES.items():
        column = model.transform(kind, evidence[name])
        low, high = np.quantile(column, [0.002, 0.998])
        table["cues"].append({"name": name, "transform": kind, "low": float(low), "high": float(high)})
    x = model.terms(table, evidence)
    weights, bias = fit_score(x, wrong, balanced(wrong))
    left_out, weight = scores_left_out(x, wrong, maps), trial_weight(trials["category"])
    kind, losses = choose_curve(left_out, wrong, weight, maps)
    scores, p = (column.tolist() for column in curve_knots(kind, left_out, wrong, weight))
    base = f"P(error > {BOUND_M:g} m) where {100 * OWN_SHARE:.0f} % of the frames are over their own place"
    table["data"] = f"{data}; {base}; {kind} curve"
    print(f"{base}: base rate {np.average(wrong, weights=weight):.3f}. Curve: {kind}; log loss over maps left out: {losses}")
    table |= {"bias": round(bias, 6), "probability": {"scores": scores, "p": p}}
    accepted = ~wrong & (np.interp(bias + x @ weights, scores, p) <= accept)
    picked = [i for i, name in enumerate(CUES) if name in SIGMA_CUES]
    sigma_weights, sigma_bias = fit_sigma(x[accepted][:, picked], trials["error_m"][accepted])
    ln_sigma = sigma_bias + x[:, picked] @ sigma_weights
    low, high = np.exp(np.quantile(ln_sigma[accepted], [0.01, 0.995]))
    sigma = np.clip(np.exp(ln_sigma), low, high)
    tail = float(np.quantile(trials["error_m"][accepted] / sigma[accepted], 0.999)) * TAIL_MARGIN
    table["sigma"] = {
        "bias": round(sigma_bias, 6),
        "least_m": round(float(low), 4),
        "most_m": round(float(high), 4),
        "tail999": round(max(tail, GAUSSIAN_TAIL999), 4),
    }
    by_name = dict(zip([list(CUES)[i] for i in picked], sigma_weights, strict=True))
    for i, cue in enumerate(table["cues"]):
        cue |= {"low": round(cue["low"], 6), "high": round(cue["high"], 6), "weight": round(float(weights[i]), 6)}
        cue["sigma_weight"] = round(float(by_name.get(cue["name"], 0.0)), 6)
    nees = (trials["error_m"][accepted] / sigma[accepted]) ** 2
    print(f"{usable.sum()} trials, {wrong.sum()} wrong; accepted at p <= {accept}: {accepted.sum()} right, ", end="")
    gate = np.interp(bias + x @ weights, scores, p) <= accept
    print(f"{(gate & wrong).sum()} wrong; match NEES {nees.mean():.2f}; sigma {low:.2f} to {high:.2f} m; tail {tail:.2f}")
    return table


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.fit", description=__doc__, formatter_class=raw)
    parser.add_argument("--trials", type=Path, required=True, help="CSV of `sthn.integrity.trials`, gates off")
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--accept", type=float, default=0.1, help="largest probability at which a fix is accepted")
    parser.add_argument("--data", default="dubai_t4_west, naip_berkeley, procedural worlds 201 and 202 (none seen in training)")
    args = parser.parse_args(words)
    table = fit(read_trials(args.trials), args.data, whole_command(parser, args), args.accept)
    manifest_rules.put(args.bundle, integrity=table)


if __name__ == "__main__":
    main()
