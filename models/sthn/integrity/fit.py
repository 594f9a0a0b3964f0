"""Fits the calibrated model on trials and puts it into the bundle.

    python -m sthn.integrity.fit --trials target/integrity/calibration.csv --bundle models/bundles/lite-1536

A logistic regression over the cues gives a score; a monotone curve (isotonic regression, the counts smoothed) turns it into
the probability of an error above 25 m. The match error of what is right is Gaussian with `ln sigma` linear in the cues, by
maximum likelihood. Only trials with gates off serve, over maps that training did not see.
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

BOUND_M = 25.0
GAUSSIAN_TAIL999 = 3.7169
TAIL_MARGIN = 1.1
"""What the tail seen on the calibration's frames is widened by: they are few for one in a thousand."""

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
    texts = {"flight", "file", "category", "status", "reason"}
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


def monotone_curve(score: np.ndarray, wrong: np.ndarray) -> tuple[list[float], list[float]]:
    """Isotonic regression; each step's probability with half a count added on both sides, so that none is 0 or 1."""
    order = np.argsort(score, kind="stable")
    score, wrong = score[order], wrong[order].astype(float)
    fitted = isotonic_regression(wrong)
    scores, p = [], []
    for begin, end in zip(fitted.blocks, fitted.blocks[1:], strict=False):
        count = end - begin
        value = (wrong[begin:end].sum() + 0.5) / (count + 1.0)
        value = max(value, p[-1]) if p else value
        for edge in {float(score[begin]), float(score[end - 1])}:
            scores.append(edge)
            p.append(float(value))
    # Rising scores, the later of equals.
    curve = dict(sorted(zip(scores, p, strict=True)))
    values = np.maximum.accumulate(list(curve.values()))
    return [round(s, 6) for s in curve], [round(float(v), 6) for v in values]


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
    table: dict[str, Any] = {"data": data, "command": command, "trials": int(usable.sum()), "bound_m": BOUND_M}
    table["cues"] = []
    for name, kind in CUES.items():
        column = model.transform(kind, evidence[name])
        low, high = np.quantile(column, [0.002, 0.998])
        table["cues"].append({"name": name, "transform": kind, "low": float(low), "high": float(high)})
    x = model.terms(table, evidence)
    # Right and wrong weigh the same.
    share = np.where(wrong, 0.5 / wrong.mean(), 0.5 / (~wrong).mean())
    weights, bias = fit_score(x, wrong, share)
    scores, p = monotone_curve(bias + x @ weights, wrong)
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
    command = f"python -m sthn.integrity.fit --trials {args.trials} --bundle {args.bundle}"
    table = fit(read_trials(args.trials), args.data, command, args.accept)
    manifest_rules.put(args.bundle, integrity=table)


if __name__ == "__main__":
    main()
