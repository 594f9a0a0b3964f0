"""The calibrated model: its fit on made-up trials, and the same numbers from Rust and from numpy."""

import argparse
import csv
import dataclasses
import json
import subprocess
from pathlib import Path

import numpy as np
import pyproj
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
    columns["reason"] = np.array([""] * count)
    # Nine in ten of the wrong ones are of nothing; by turns over four maps, at the three radii.
    columns["category"] = np.where(wrong & (rng.random(count) < 0.9), "noise", "localisable")
    columns["map"] = np.array([f"map{i % 4}" for i in range(count)])
    columns["flight"] = np.array([("exact-0" if i % 5 == 0 else "test-0") for i in range(count)])
    columns["radius_m"] = np.array([trials.RADII[i % 3] for i in range(count)])
    for name in ("radius95_m", "radius999_m", "sigma_m", "p_over_25m"):
        columns[name] = np.full(count, 20.0)
    columns["e.frame_texture"] = np.full(count, 9.0)
    columns["e.prior_chi2"] = np.where(np.arange(count) % 2 == 0, rng.chisquare(2, count) + 4 * wrong, np.nan)
    return columns


@pytest.fixture(scope="module")
def table() -> dict:
    return fit.fit(made_up(1500, 1), "made up", "none", accept=0.1)


def test_probability_is_calibrated_and_sigma_is_found(table: dict) -> None:
    other = made_up(1500, 2)
    evidence = fit.evidence_of(other)
    p, sigma = model.judge(table, evidence)
    wrong = other["error_m"] > fit.BOUND_M
    weight = fit.trial_weight(other["category"])
    for low, high in ((0.0, 0.1), (0.1, 0.9), (0.9, 1.01)):
        here = (p >= low) & (p < high)
        stated, found = (np.average(column[here], weights=weight[here]) for column in (p, wrong))
        assert abs(stated - found) < 0.08, (low, stated, found)
    accepted = (p < 0.1) & ~wrong
    assert accepted.sum() > 800
    nees = (other["error_m"][accepted] / sigma[accepted]) ** 2
    order = np.argsort(sigma[accepted])
    for part in np.array_split(nees[order], 3):
        assert 1.6 < part.mean() < 2.4, part.mean()
    assert table["sigma"]["tail999"] >= fit.GAUSSIAN_TAIL999


def test_no_probability_is_certain_and_none_leaps(table: dict) -> None:
    p, scores = np.array(table["probability"]["p"]), np.array(table["probability"]["scores"])
    assert 0 < p[0] < 0.01 and 0.95 < p[-1] < 1
    assert len(p) == fit.KNOTS and (np.diff(scores) > 0).all() and (np.diff(p) >= 0).all()
    assert np.diff(p).max() < 0.5
    assert table["data"].endswith("curve") and "80 %" in table["data"]


def test_the_fit_is_the_same_twice_and_whatever_the_order_of_the_trials(table: dict) -> None:
    again = fit.fit(made_up(1500, 1), "made up", "none", accept=0.1)
    assert again == table
    turned = fit.fit({name: column[::-1] for name, column in made_up(1500, 1).items()}, "made up", "none", accept=0.1)
    assert np.allclose(turned["probability"]["p"], table["probability"]["p"], atol=2e-3)


def test_a_fit_needs_maps_to_leave_out() -> None:
    one = made_up(300, 3) | {"map": np.array(["a"] * 300)}
    with pytest.raises(SystemExit, match="at least two maps"):
        fit.fit(one, "made up", "none", accept=0.1)


def test_own_places_have_their_share_of_the_weight() -> None:
    category = np.array(["localisable"] * 3 + ["water"] + ["noise"] * 12)
    weight = fit.trial_weight(category)
    assert weight.mean() == pytest.approx(1.0)
    assert weight[:4].sum() / weight.sum() == pytest.approx(fit.OWN_SHARE)
    assert fit.trial_weight(category[:4]).tolist() == [1.0] * 4 and fit.trial_weight(category[4:]).tolist() == [1.0] * 12


def scores(count: int, seed: int, p_of) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scores from -4 to 4, right or wrong by `p_of`, over four maps."""
    rng = np.random.default_rng(seed)
    score = rng.uniform(-4, 4, count)
    maps = np.array(["abcd"[i % 4] for i in range(count)])
    return score, rng.random(count) < p_of(score), np.ones(count), maps


def test_a_logistic_truth_is_found_and_chosen() -> None:
    score, wrong, weight, maps = scores(4000, 5, lambda s: 1 / (1 + np.exp(-(1.5 * s - 1))))
    slope, offset = fit.fit_logistic(score, wrong, weight)
    assert slope == pytest.approx(1.5, abs=0.1) and offset == pytest.approx(-1.0, abs=0.15)
    kind, losses = fit.choose_curve(score, wrong, weight, maps)
    assert kind in ("logistic", "mean") and losses[kind] == min(losses.values())
    at, p = fit.curve_knots(kind, score, wrong, weight)
    inner = np.linspace(-3, 3, 50)
    assert np.abs(np.interp(inner, at, p) - 1 / (1 + np.exp(-(1.5 * inner - 1)))).max() < 0.05


def test_what_is_no_logistic_curve_is_not_forced_into_one() -> None:
    # A plateau at 0.3 that no logistic has.
    score, wrong, weight, maps = scores(4000, 6, lambda s: np.where(s < -3, 0.01, np.where(s < 3, 0.3, 0.99)))
    kind, losses = fit.choose_curve(score, wrong, weight, maps)
    assert kind == "isotonic", losses


def test_separable_trials_and_reversed_ones_give_a_usable_curve() -> None:
    score = np.concatenate([np.linspace(-3, -1, 200), np.linspace(1, 3, 200)])
    wrong = score > 0
    for kind in fit.CURVES:
        for found in (wrong, ~wrong):
            at, p = fit.curve_knots(kind, score, found, np.ones(400))
            assert np.isfinite(p).all() and (np.diff(at) > 0).all() and (np.diff(p) >= 0).all(), kind
            assert 0 < p[0] and p[-1] < 1, kind


def test_weights_move_the_probability_and_not_the_order() -> None:
    score, wrong, _, _ = scores(4000, 7, lambda s: 1 / (1 + np.exp(-s)))
    heavy = np.where(wrong, 0.25, 1.0)
    _, even = fit.curve_knots("logistic", score, wrong, np.ones(4000))
    at, light = fit.curve_knots("logistic", score, wrong, heavy)
    # A quarter of the weight is a quarter of the odds.
    assert np.interp(np.log(4), at, light) == pytest.approx(0.5, abs=0.05)
    assert (np.diff(even) >= 0).all()


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
    p, wrong = np.array([0.1, 0.1, 0.9, 0.9]), np.array([False, False, True, False])
    bins = report.calibration_bins(p, wrong, np.array([1.0, 1.0, 3.0, 1.0]))
    assert sum(b["trials"] for b in bins) == 4 and bins[0] == {"trials": 1, "stated": 0.1, "found": 0.0}


def test_a_cue_is_measured_on_what_was_searched_at_each_radius() -> None:
    table = {name: column[:600] for name, column in made_up(1500, 8).items()}
    everywhere = report.cue_curves(table)
    # What belongs nowhere and was searched at 512 m says nothing of 64 m.
    table["e.peak_mass"] = np.where((table["category"] == "noise") & (table["radius_m"] == 512), 1.0, table["e.peak_mass"])
    other = report.cue_curves(table)
    assert other["peak_mass"]["64"][2] == everywhere["peak_mass"]["64"][2] > 0.9
    assert other["peak_mass"]["512"][2] < 0.6
    assert set(everywhere["prior_chi2"]) == {"64", "256", "512", "own place only"} and everywhere["prior_chi2"]["256"][2] > 0.6


def test_the_report_is_written_whole(tmp_path: Path, table: dict) -> None:
    rows = made_up(900, 9)
    rows["file"] = np.array([f"{i}.png" for i in range(900)])
    names = list(rows)
    trials.write_table([{n: rows[n][i] for n in names} for i in range(900)], tmp_path / "test.csv")
    (tmp_path / "test.command").write_text("python -m sthn.integrity.trials --plan test --maps MAPS\n")
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    whole = read_bundle(ROOT / "models/bundles/lite-1536").manifest | {"integrity": table}
    (bundle / "bundle.toml").write_text(manifest.to_toml(manifest.ordered(whole)))
    report.main(["--trials", str(tmp_path / "test.csv"), "--bundle", str(bundle), "--out", str(tmp_path / "out")])
    text = (tmp_path / "out/README.md").read_text()
    assert "`python -m sthn.integrity.trials --plan test --maps MAPS`" in text and f"--out {tmp_path / 'out'}`" in text
    assert "| `prior_chi2` |" in text and "80 %" in text and "Largest gap" in text
    assert (tmp_path / "out/cues.jpg").stat().st_size > 10_000


def test_a_plan_names_every_flight_once_and_splits_the_maps() -> None:
    for name, flights in trials.PLANS.items():
        assert len({f.name for f in flights}) == len(flights), name
    seen = {name: {f.over or f.source for f in flights} for name, flights in trials.PLANS.items()}
    assert not seen["calibration"] & seen["test"]
    assert all(len({f.seed for f in flights}) == len(flights) for flights in trials.PLANS.values())


def test_what_belongs_nowhere_is_searched_at_every_radius_alike() -> None:
    for name, least in (("test", 300), ("calibration", 100)):
        for category in ("another place", "blank", "shutter", "noise", "hituav"):
            flights = [f for f in trials.PLANS[name] if f.category == category]
            by_radius = [sum(f.frames for f in flights if f.radius_m == r) for r in trials.RADII]
            assert sum(by_radius) == least and max(by_radius) - min(by_radius) <= 2, (name, category, by_radius)
    assert trials.WATER_PLACES % len(trials.RADII) == 0
    assert all(f.sigma_prior for f in trials.PLANS["test"] if f.name.startswith("exact"))


def poses(folder: Path, count: int) -> None:
    """A flight's rows."""
    folder.mkdir()
    row = {"file": "a.png", "stamp_ns": "1", "prior_lat_deg": "25.1", "prior_lon_deg": "55.1", "prior_radius_m": "256"}
    row |= {"truth_lat_deg": "25.2", "truth_lon_deg": "55.3"}
    trials.write_table([row] * count, folder / "poses.csv")


def test_a_prior_that_states_a_sigma_is_drawn_from_it_and_has_the_same_disc(tmp_path: Path) -> None:
    poses(tmp_path / "own", 400)
    flight = trials.Flight("a", "m.tif", 3, 400, 256.0, sigma_prior=True)
    trials.state_sigma(tmp_path / "own", flight)
    with (tmp_path / "own/poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["prior_radius_m"] for row in rows} == {""} and {3 * float(row["prior_sigma_m"]) for row in rows} == {256.0}
    geod = pyproj.Geod(ellps="WGS84")
    off = np.array([geod.inv(55.3, 25.2, float(r["prior_lon_deg"]), float(r["prior_lat_deg"]))[2] for r in rows])
    assert off.max() < 256.0 and ((off / (256 / 3)) ** 2).mean() == pytest.approx(1.9, abs=0.25)
    poses(tmp_path / "elsewhere", 2)
    trials.state_sigma(tmp_path / "elsewhere", dataclasses.replace(flight, over="other.tif"))
    with (tmp_path / "elsewhere/poses.csv").open() as file:
        assert {row["prior_lat_deg"] for row in csv.DictReader(file)} == {"25.1"}


def test_a_command_in_a_report_is_whole(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    parser = argparse.ArgumentParser(prog="sthn.integrity.some")
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--areas", type=float, nargs="+", default=[1, 2.5])
    parser.add_argument("--maps", type=Path)
    parser.add_argument("--quick", action="store_true")
    command = trials.whole_command(parser, parser.parse_args(["--bundle", "a b"]))
    assert command == "python -m sthn.integrity.some --bundle 'a b' --areas 1 2.5"
    again = trials.whole_command(parser, parser.parse_args(["--bundle", "x", "--maps", "m", "--quick", "--areas", "3"]))
    assert again == "python -m sthn.integrity.some --bundle x --areas 3 --maps m --quick"


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
