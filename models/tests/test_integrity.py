"""The calibrated model: its fit on made-up trials, and the same numbers from Rust and from numpy."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from sthn import manifest
from sthn.bundle import read_bundle
from sthn.integrity import fit, model, report, trials


def made_up(count: int, seed: int) -> dict[str, np.ndarray]:
    """Trials in which three cues tell right from wrong and one tells sigma; the others say nothing."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(count) < 0.3
    columns = {f"e.{name}": rng.random(count) for name in fit.CUES}
    columns["e.peak_mass"] = np.clip(np.where(wrong, 0.4, 0.9) + 0.15 * rng.standard_normal(count), 0, 1)
    columns["e.gradient_agreement"] = np.where(wrong, 0.0, 0.2) + 0.06 * rng.standard_normal(count)
    sigma = np.exp(rng.uniform(-1, 1.5, count))
    columns["e.refine_match_sigma_m"] = sigma
    right = sigma * np.sqrt(-2 * np.log(rng.random(count)))
    columns["error_m"] = np.where(wrong, rng.uniform(30, 600, count), np.minimum(right, 24.9))
    columns["status"] = np.array(["fix"] * count)
    return columns


@pytest.fixture(scope="module")
def table() -> dict:
    return fit.fit(made_up(1500, 1), "made up", "none", accept=0.1)


def test_probability_is_calibrated_and_sigma_is_found(table: dict) -> None:
    other = made_up(1500, 2)
    evidence = fit.evidence_of(other)
    p, sigma = model.judge(table, evidence)
    wrong = other["error_m"] > fit.BOUND_M
    for low, high in ((0.0, 0.1), (0.1, 0.9), (0.9, 1.01)):
        here = (p >= low) & (p < high)
        assert abs(p[here].mean() - wrong[here].mean()) < 0.08, (low, p[here].mean(), wrong[here].mean())
    accepted = (p < 0.1) & ~wrong
    assert accepted.sum() > 800
    nees = (other["error_m"][accepted] / sigma[accepted]) ** 2
    order = np.argsort(sigma[accepted])
    for part in np.array_split(nees[order], 3):
        assert 1.6 < part.mean() < 2.4, part.mean()
    assert table["sigma"]["tail999"] >= fit.GAUSSIAN_TAIL999


def test_no_probability_is_certain(table: dict) -> None:
    p = table["probability"]["p"]
    assert 0 < p[0] < 0.01 and 0.99 < p[-1] < 1


def test_the_manifest_takes_the_table_and_refuses_a_broken_one(table: dict) -> None:
    whole = read_bundle(ROOT / "models/bundles/lite-1536").manifest | {"integrity": table}
    manifest.check(whole)
    manifest.to_toml(manifest.ordered(whole))
    falling = table | {"probability": {"scores": [0.0, 1.0], "p": [0.5, 0.4]}}
    with pytest.raises(manifest.ManifestError, match=r"integrity\.probability"):
        manifest.check(whole | {"integrity": falling})
    with pytest.raises(manifest.ManifestError, match=r"integrity\.cues\[0\]\.weight"):
        manifest.check(whole | {"integrity": table | {"cues": [{k: v for k, v in table["cues"][0].items() if k != "weight"}]}})


def test_bounds_and_curves_by_hand() -> None:
    assert report.upper_bound(0, 100) == pytest.approx(1 - 0.05 ** (1 / 100))
    assert report.roc(np.array([1.0, 2.0, 3.0, 4.0]), np.array([False, False, True, True]))[2] == 1.0
    assert report.roc(np.ones(4), np.array([False, True, False, True]))[2] == 0.5


def test_a_plan_names_every_flight_once_and_splits_the_maps() -> None:
    for name, flights in trials.PLANS.items():
        assert len({f.name for f in flights}) == len(flights), name
    seen = {name: {f.over or f.source for f in flights} for name, flights in trials.PLANS.items()}
    assert not seen["calibration"] & seen["test"]


def test_rust_and_numpy_judge_alike(tmp_path: Path) -> None:
    bundle = ROOT / "models/bundles/lite-1536"
    table = read_bundle(bundle).manifest.get("integrity")
    if table is None:
        pytest.skip("the bundle has no calibration")
    nightfix = ROOT / "target/debug/nightfix"
    if not nightfix.exists():
        pytest.skip(f"{nightfix} is not built")
    # The committed flight's map is too coarse for the calibration to hold.
    flight = tmp_path / "flight"
    world = ["--world", "5", "--world-size-m", "1800", "--frames", "8", "--seed", "5", "--radius-m", "256", "--report-attitude"]
    subprocess.run([nightfix, "simulate", "--out", flight, *world], check=True, capture_output=True)
    command = [nightfix, "replay", flight, "--bundle", bundle, "--out", tmp_path, "--gates", "off"]
    subprocess.run(command, check=True, capture_output=True)
    lines = [json.loads(line) for line in (tmp_path / "fixes.jsonl").open()]
    fixes = [line for line in lines if "p_over_25m" in line]
    assert len(fixes) == 8
    evidence = {cue["name"]: np.array([f["evidence"][cue["name"]] for f in fixes]) for cue in table["cues"]}
    p, sigma = model.judge(table, evidence)
    assert np.allclose(p, [f["p_over_25m"] for f in fixes], atol=1e-9)
    assert np.allclose(sigma, [f["evidence"]["sigma_match_m"] for f in fixes], atol=1e-9)
    assert all(f["calibrated"] for f in fixes)
