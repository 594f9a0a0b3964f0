"""The integrity report: is the error that is stated the error that is made?

    python -m sthn.integrity.report --trials target/integrity/test.csv --bundle models/bundles/lite-1536 \
        --out models/reports/integrity

The trials have an answer for every frame, with the reason for which the gates would have withheld it: what has none is what
the service publishes. Trials that belong nowhere count at the D_C at which they were searched. Writes README.md, numbers.json
and two pictures.
"""

from __future__ import annotations

import argparse
import json
import math
import tomllib
from pathlib import Path

import numpy as np
from scipy.stats import beta

from . import model
from .fit import BOUND_M, CUES, OWN, OWN_SHARE, evidence_of, read_trials, trial_weight
from .trials import RADII, whole_command

FALLING = ("peak_mass", "peak_logit", "cycle_mass", "refine_weight", "gradient_agreement", "quad_side_ratio", "frame_smoothness")
"""Cues that are high where the match is right."""
ALONE = (*CUES, "quad_scale_error", "quad_turn_deg", "prior_distance_share", "prior_chi2", "frame_texture", "map_texture")
"""Cues that are measured alone. `prior_chi2` is there where the prior states a sigma: `sigma_prior` of a plan."""
RISING_TEXTURES = ("frame_texture", "map_texture")
CALIBRATION_BINS = 10
MIN_TEXTURE = 5.0
"""A frame is localisable where its 16 m means differ by this many grey levels, 1-sigma (`frame_texture`)."""
NEGATIVE = ("another place", "turned", "blank", "shutter", "noise", "hituav", "open water")


def upper_bound(count: int, of: int, level: float = 0.95) -> float:
    """Clopper-Pearson: the share is below this with probability `level`."""
    return 1.0 if count >= of else float(beta.ppf(level, count + 1, of - count))


def roc(score: np.ndarray, wrong: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """False and true positive rates of "wrong where the score is high", and the area below."""
    order = np.argsort(-score, kind="stable")
    hits, misses = np.cumsum(wrong[order]), np.cumsum(~wrong[order])
    last = np.append(np.diff(score[order]) != 0, True)
    tpr = np.concatenate([[0.0], hits[last] / max(1, wrong.sum())])
    fpr = np.concatenate([[0.0], misses[last] / max(1, (~wrong).sum())])
    return fpr, tpr, float(np.trapezoid(tpr, fpr))


Curve = tuple[np.ndarray, np.ndarray, float]


def cue_curves(trials: dict[str, np.ndarray]) -> dict[str, dict[str, Curve]]:
    """The curve of every cue alone, by D_C: whatever was searched at that D_C, frames that belong nowhere too (wrong places in
    the window itself are too few to draw a curve); and over frames over their own place alone."""
    evidence = evidence_of(trials)
    wrong = ~(trials["error_m"] <= BOUND_M)
    answered = trials["status"] == "fix"
    parts = {f"{radius_m:.0f}": trials["radius_m"] == radius_m for radius_m in RADII}
    parts["own place only"] = np.isin(trials["category"], OWN)
    found: dict[str, dict[str, Curve]] = {}
    for name in ALONE:
        if name not in evidence:
            continue
        sign = -1.0 if name in FALLING or name in RISING_TEXTURES else 1.0
        usable = answered & np.isfinite(evidence[name])
        found[name] = {}
        for part, of in parts.items():
            here = usable & of
            if wrong[here].any() and not wrong[here].all():
                found[name][part] = roc(sign * evidence[name][here], wrong[here])
    return found


def consistency(error_m: np.ndarray, sigma_m: np.ndarray, radius95_m: np.ndarray) -> dict:
    """NEES (2 degrees of freedom), overall and by tercile of the stated radius, and what the 95 % radius holds."""
    nees = (error_m / sigma_m) ** 2
    edges = np.quantile(radius95_m, [1 / 3, 2 / 3])
    tercile = np.digitize(radius95_m, edges)
    return {
        "fixes": len(error_m),
        "nees": float(nees.mean()),
        "nees_by_tercile": [float(nees[tercile == i].mean()) if (tercile == i).any() else None for i in range(3)],
        "tercile_radius95_m": [float(np.median(radius95_m[tercile == i])) if (tercile == i).any() else None for i in range(3)],
        "within_radius95": float((error_m <= radius95_m).mean()),
    }


def calibration_bins(p: np.ndarray, wrong: np.ndarray, weight: np.ndarray) -> list[dict]:
    """Stated against found in bins of as much weight each, by the stated probability."""
    bins = []
    order = np.argsort(p, kind="stable")
    cumulated = np.cumsum(weight[order]) / weight.sum()
    which = np.minimum((cumulated - 0.5 * weight[order] / weight.sum()) * CALIBRATION_BINS, CALIBRATION_BINS - 1).astype(int)
    for part in (order[which == i] for i in range(CALIBRATION_BINS)):
        if len(part):
            stated, found = (float(np.average(column[part], weights=weight[part])) for column in (p, wrong))
            bins.append({"trials": len(part), "stated": stated, "found": found})
    return bins


def measure(off: dict[str, np.ndarray], bundle: Path) -> dict:
    """All numbers."""
    table = tomllib.loads((bundle / "bundle.toml").read_text())["integrity"]
    evidence = evidence_of(off)
    usable = (off["status"] == "fix") & np.all([np.isfinite(evidence[cue["name"]]) for cue in table["cues"]], 0)
    p = np.full(len(usable), 1.0)
    p[usable], sigma = model.judge(table, {name: column[usable] for name, column in evidence.items()})
    wrong = ~(off["error_m"] <= BOUND_M)
    own = np.isin(off["category"], OWN)
    numbers: dict = {"bundle": bundle.name, "fitted_on": table["data"], "bound_m": BOUND_M}
    numbers["cues"] = {name: {part: curve[2] for part, curve in row.items()} for name, row in cue_curves(off).items()}
    weight, even = trial_weight(off["category"][usable]), np.ones(len(usable))
    numbers["calibration"] = {
        f"all trials, own place {100 * OWN_SHARE:.0f} % of the weight": calibration_bins(p[usable], wrong[usable], weight),
        "own place only": calibration_bins(p[usable & own], wrong[usable & own], even[usable & own]),
        "all trials, each the same weight": calibration_bins(p[usable], wrong[usable], even[usable]),
    }
    match = usable & own & ~wrong & (p <= 0.1) & np.char.startswith(off["flight"], "exact")
    if match.any():
        own_sigma = sigma[match[usable]]
        numbers["match alone"] = consistency(off["error_m"][match], own_sigma, own_sigma * np.sqrt(5.9915))
    order = np.argsort(p[usable & own], kind="stable")
    risk = np.cumsum(wrong[usable & own][order]) / np.arange(1, len(order) + 1)
    numbers["risk_coverage"] = [
        {"coverage": c, "risk_over_25m": float(risk[max(0, int(c * len(order)) - 1)])} for c in (0.25, 0.5, 0.75, 0.9, 0.95, 1.0)
    ]
    # As the service answers: what has a reason is withheld. `exact` flights are those of the match alone.
    served = ~np.char.startswith(off["flight"], "exact")
    on = {name: column[served] for name, column in off.items()}
    texture = evidence_of(on)["frame_texture"]
    localisable = (on["category"] == "localisable") & ((texture >= MIN_TEXTURE) | ~np.isfinite(texture))
    fixed = (on["status"] == "fix") & (on["reason"] == "")
    accepted = localisable & fixed
    service = own_fixes(on, fixed & np.isin(on["category"], OWN))
    beyond = int((on["error_m"][accepted] > 50).sum())
    numbers["service"] = service | {
        "localisable_frames": int(localisable.sum()),
        "accepted": int(accepted.sum()),
        "accepted_share": float(accepted.sum() / max(1, localisable.sum())),
        "accepted_over_50m": beyond,
        "accepted_over_50m_upper_bound": upper_bound(beyond, int(accepted.sum())),
        "by_radius_m": {
            f"{r:.0f}": float((accepted & (on["radius_m"] == r)).sum() / max(1, (localisable & (on["radius_m"] == r)).sum()))
            for r in RADII
        },
        "no_fix_reasons": dict(
            zip(*[a.tolist() for a in np.unique(on["reason"][localisable & ~fixed], return_counts=True)], strict=True)
        ),
    }
    shore = (on["category"] == "water") & fixed
    numbers["service"]["over_60_percent_water"] = {
        "frames": int((on["category"] == "water").sum()),
        "fixes": int(shore.sum()),
        "fixes_over_25m": int((on["error_m"][shore] > 25).sum()),
    }
    numbers["negative"] = {}
    for category in NEGATIVE:
        here = on["category"] == category
        if not here.any():
            continue
        published = here & fixed
        reasons = dict(zip(*[a.tolist() for a in np.unique(on["reason"][here & ~fixed], return_counts=True)], strict=True))
        numbers["negative"][category] = {
            "trials": int(here.sum()),
            "no_fix": int((here & ~fixed).sum()),
            "share": float((here & ~fixed).sum() / here.sum()),
            "published_within_25m": int((on["error_m"][published] <= 25).sum()),
            "reasons": reasons,
        }
    return numbers


def own_fixes(on: dict[str, np.ndarray], fixed: np.ndarray) -> dict:
    """Stated against made, of the service's fixes."""
    error, sigma = on["error_m"][fixed], on["sigma_m"][fixed]
    found = consistency(error, sigma, on["radius95_m"][fixed])
    found |= {
        "within_radius999": int((error <= on["radius999_m"][fixed]).sum()),
        "median_m": float(np.median(error)),
        "mean_m": float(error.mean()),
        "p95_m": float(np.percentile(error, 95)),
        "over_25m": float((error > 25).mean()),
        "over_50m": float((error > 50).mean()),
    }
    return found


def pictures(off: dict[str, np.ndarray], numbers: dict, out: Path) -> None:
    """Curves of the cues; calibration, risk and coverage."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    curves = cue_curves(off)
    names = sorted(curves, key=lambda name: -numbers["cues"][name].get("512", 0))
    columns = 5
    size = (2.6 * columns, 2.5 * math.ceil(len(names) / columns))
    figure, axes = plt.subplots(math.ceil(len(names) / columns), columns, figsize=size, sharex=True, sharey=True, squeeze=False)
    for axis, name in zip(axes.flat, names, strict=False):
        for radius_m in RADII:
            if f"{radius_m:.0f}" in curves[name]:
                fpr, tpr, area = curves[name][f"{radius_m:.0f}"]
                axis.plot(fpr, tpr, linewidth=1, label=f"{radius_m:.0f} m: {area:.3f}")
        axis.plot([0, 1], [0, 1], color="0.8", linewidth=0.8)
        axis.set_title(name, fontsize=9)
        axis.legend(fontsize=6, loc="lower right")
        axis.grid(alpha=0.3)
    for axis in list(axes.flat)[len(names) :]:
        axis.set_visible(False)
    figure.supxlabel("right answers refused", fontsize=10)
    figure.supylabel("wrong answers found", fontsize=10)
    figure.tight_layout()
    figure.savefig(out / "cues.jpg", dpi=70)
    plt.close(figure)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2))
    axes[0].plot([0, 1], [0, 1], color="0.7")
    for name, bins in numbers["calibration"].items():
        axes[0].plot([b["stated"] for b in bins], [b["found"] for b in bins], "o-", markersize=4, label=name)
    axes[0].legend(fontsize=7)
    axes[0].set(title="P(error > 25 m)", xlabel="stated", ylabel="found")
    axes[1].plot([r["coverage"] for r in numbers["risk_coverage"]], [r["risk_over_25m"] for r in numbers["risk_coverage"]], "o-")
    axes[1].set(title="own place, gates off", xlabel="coverage", ylabel="share above 25 m")
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(out / "calibration.jpg", dpi=80)
    plt.close(figure)


def text(numbers: dict, commands: list[str]) -> str:
    """The report."""
    service = numbers["service"]
    lines = ["# Integrity of " + numbers["bundle"], ""]
    lines += [line for command in commands for line in (f"`{command}`", "")]
    lines += [f"Fitted on: {numbers['fitted_on']}. Tested on maps that neither training nor the fit saw.", ""]
    lines += ["## What the service states, and what it makes", ""]
    rows = [("the whole stated error", service)]
    if "match alone" in numbers:
        rows.append(("the match alone", numbers["match alone"]))
    lines += [
        "| | fixes | mean NEES (2 is right) | by tercile of the radius | median radius95_m of each | error within radius95_m |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    for name, row in rows:
        terciles = ", ".join("-" if v is None else f"{v:.2f}" for v in row["nees_by_tercile"])
        radii = ", ".join("-" if v is None else f"{v:.1f}" for v in row["tercile_radius95_m"])
        lines.append(
            f"| {name} | {row['fixes']} | {row['nees']:.2f} | {terciles} | {radii} | {100 * row['within_radius95']:.1f} % |"
        )
    lines += [""]
    lines += [
        f"`radius999_m` held {service['within_radius999']} of {service['fixes']} errors. Errors of the fixes: median "
        f"{service['median_m']:.2f} m, mean {service['mean_m']:.2f} m, P95 {service['p95_m']:.2f} m, above 25 m "
        f"{100 * service['over_25m']:.2f} %, above 50 m {100 * service['over_50m']:.2f} %.",
        "",
        f"Of {service['localisable_frames']} localisable frames (under 60 % water, `frame_texture` at least {MIN_TEXTURE:.0f}) "
        f"{service['accepted']} got a fix ({100 * service['accepted_share']:.1f} %); by D_C: "
        + ", ".join(f"{r} m {100 * v:.1f} %" for r, v in service["by_radius_m"].items())
        + f". {service['accepted_over_50m']} of them are beyond 50 m; the share is below "
        f"{100 * service['accepted_over_50m_upper_bound']:.2f} % with 95 % confidence. Reasons of the others: "
        + (", ".join(f"{k} {v}" for k, v in service["no_fix_reasons"].items()) or "none")
        + ".",
        "",
        f"Of {service['over_60_percent_water']['frames']} further frames with more than 60 % water (a shore may be in sight) "
        f"{service['over_60_percent_water']['fixes']} got a fix, {service['over_60_percent_water']['fixes_over_25m']} of them "
        "beyond 25 m.",
        "",
    ]
    lines += ["## What must not be placed", "", "| frames | trials | no fix | share | reasons |", "|---|---|---|---|---|"]
    for name, row in numbers["negative"].items():
        reasons = ", ".join(f"{k} {v}" for k, v in row["reasons"].items())
        lines.append(f"| {name} | {row['trials']} | {row['no_fix']} | {100 * row['share']:.1f} % | {reasons} |")
    lines += [
        "",
        "Open water: more than 99 % of the footprint.",
        "",
        "## P(error > 25 m): stated and found",
        "",
        f"The probability is that of a frame in a flight of which {100 * OWN_SHARE:.0f} % of the frames are over the place that "
        "the prior says (water too), the others elsewhere or of nothing. In another mixture another share is found where the "
        "evidence leaves a doubt.",
        "",
        "| trials | stated | found | |",
        "|---|---|---|---|",
    ]
    for name, bins in numbers["calibration"].items():
        lines += [f"| {b['trials']} | {b['stated']:.4f} | {b['found']:.4f} | {name} |" for b in bins]
    gaps = {name: max(abs(b["stated"] - b["found"]) for b in bins) for name, bins in numbers["calibration"].items()}
    lines += ["", "Largest gap of a bin, in points: " + ", ".join(f"{name} {100 * gap:.1f}" for name, gap in gaps.items()) + "."]
    lines += ["", "![calibration, risk and coverage](calibration.jpg)", "", "## Each cue alone", ""]
    lines += ['Area under the curve of "error above 25 m" (0.5 is chance). By D_C: frames over their own place and']
    lines += ["frames that belong nowhere, both searched at that D_C; last column: own place only, water included."]
    lines += [
        "`prior_chi2` is evidence of priors that state a sigma, not of those that state a radius: part of the trials do.",
        "",
    ]
    lines += ["| cue | 64 m | 256 m | 512 m | own place only |", "|---|---|---|---|---|"]
    columns = ("64", "256", "512", "own place only")
    for name, row in sorted(numbers["cues"].items(), key=lambda item: -item[1].get("512", 0)):
        lines.append(f"| `{name}` | " + " | ".join(f"{row[c]:.3f}" if c in row else "-" for c in columns) + " |")
    return "\n".join([*lines, "", "![curves of every cue](cues.jpg)", ""])


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.report", description=__doc__, formatter_class=raw)
    parser.add_argument("--trials", type=Path, required=True, help="CSV of `sthn.integrity.trials`")
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(words)
    trials = read_trials(args.trials)
    numbers = measure(trials, args.bundle)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "numbers.json").write_text(json.dumps(numbers, indent=1) + "\n")
    made_by = args.trials.with_suffix(".command")
    commands = [*([made_by.read_text().strip()] if made_by.exists() else []), whole_command(parser, args)]
    (args.out / "README.md").write_text(text(numbers, commands))
    pictures(trials, numbers, args.out)
    print(text(numbers, commands))


if __name__ == "__main__":
    main()
