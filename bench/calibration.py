"""Make the probabilities of the diagnosis from records with known truth, and show how well they hold.

    python -m bench.calibration --first 2000 --json scores.json        diagnose every record, keep the raw scores
    python -m bench.calibration --scores scores.json --write           make identify/diagnosis/probability.json of them
    python -m bench.calibration --scores report.json                   how well the probabilities hold on those

The records: the emulator's hidden effects in all strengths, two at once, causes outside the library, nothing hidden,
other recorders, faults of the rig, and muscles of other physics. Seeds from 2000 made the map; report on seeds from
3000.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from bench.common import ROOT, in_processes, table, write_json, written_by
from bench.muscles.hidden_records import generate, sampled
from bench.muscles.other_physics import SETS, draw_muscle
from bench.muscles.physics_records import NOISE_SD_NM, RATE_HZ, record_of_physics
from bench.muscles.recorders import recorded
from stimrig.hardware_sim.hidden.design import Design, make_design
from stimrig.hardware_sim.hidden.library import EFFECTS, OUTSIDERS
from stimrig.hardware_sim.hidden.scenario import draw_pair, rng_of
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.diagnosis.free import search_record
from stimrig.identify.diagnosis.probability import logistic, scores_of_remainder
from stimrig.identify.diagnosis.verdict import examine, judge
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import as_record

MAP = ROOT / "identify" / "diagnosis" / "probability.json"
RECORDERS = ("plain", "real", "plain", "gap", "offset+counts", "plain", "start+negative", "scaled")
FAULTS = ("dropped", "late", "gap")
RECORDINGS: tuple[dict[str, Any], ...] = (
    {}, {"noise": "ar1"}, {"steep": True}, {"noise": "slow"}, {"rate_hz": 100}, {"with_validate": False},
    {"design": "short"},
)  # fmt: skip
STRENGTHS = ("weak", "middle", "strong")
RIDGE = 0.5
"""Weight of the squares of the map's weights: a prior that is as wide as the scores are sure."""
SURE_PROBABILITY = 0.9
Job = tuple[str, str, str, int, dict[str, Any]]
"""Set, what is in the muscle, strength or protocol, seed, settings."""
Row = dict[str, Any]


def jobs(first: int) -> list[Job]:
    """Return the records of a campaign whose seeds begin at `first`, in a random order."""
    rows: list[Job] = []

    def add(kind: str, what: str, strength: str, number: int, **options: Any) -> None:
        recorder = RECORDERS[len(rows) % len(RECORDERS)]
        rows.append((kind, what, strength, first + number, {"recorder": recorder} | options))

    for number in range(3):
        for effect in EFFECTS:
            for strength in STRENGTHS:
                add("single", effect, strength, number)
    for number in range(84):
        add("nothing", "", "middle", number, **RECORDINGS[number % len(RECORDINGS)])
    for number in range(4):
        for outsider in OUTSIDERS:
            for strength in STRENGTHS[1:]:
                add("outside", outsider, strength, number)
    for number in range(40):
        add("two", "+".join(draw_pair(rng_of(first + number, "pair"))), "middle", number)
    for number, effect in enumerate(("fatigue", "asymmetric_relaxation", "electromechanical_delay", "catch_like")):
        for options in RECORDINGS[4:]:
            add("single", effect, "middle", 10 + number, **options)
    for name, kinds in SETS.items():
        for number in range(3 * len(kinds) or 16):
            for protocol in ("mixed", "full")[: 2 if number < 2 * len(kinds) or not kinds else 1]:
                add("physics", name, protocol, number)
    for fault in FAULTS:
        for number in range(12):
            add("fault", fault, "middle", number)
    order = np.random.default_rng(first).permutation(len(rows))
    return [rows[int(place)] for place in order]


def make(job: Job) -> tuple[Record, Row]:
    """Return the record of a job and its truth: `kind`, `true` (names that are no mistake), `more` (always missing)."""
    kind, what, strength, seed, options = job
    if kind == "physics":
        generated = record_of_physics(what, seed, protocol=strength)
        truth = generated["truth"]
        more = bool(SETS[what]) or "breath" in truth["disturbed"]
        return as_record(generated), {"kind": truth["kind"], "true": truth["true"], "more": more}
    if kind == "fault":
        more = None if what != "gap" else False  # what a fault adds is in the record, though the muscle lacks nothing
        return faulty(what, seed), {"kind": what, "true": [], "more": more}
    settings = dict(options)
    recorder = settings.pop("recorder")
    generated = generate(tuple(what.split("+")) if what else None, strength, seed, **settings)
    truth = generated["truth"]["effects"]
    label = "two" if "+" in what else what or "nothing"
    return as_record(recorded(generated, recorder, seed)), {"kind": label, "true": truth, "more": kind == "outside"}


def faulty(fault: str, seed: int) -> Record:
    """A plain muscle in a record at fault: pulses that did not come, pulses that came late, rows that are missing."""
    rng = rng_of(seed, "fault", fault)
    muscle = draw_muscle("plain", seed, rng)
    design = make_design("full", rng, float(muscle.base.largest_width_us))
    felt_us = design.width_us.copy()
    at_fault = rng.choice(np.flatnonzero(felt_us > 0)[1:], int(rng.integers(2, 9)), replace=False)
    if fault == "dropped":
        felt_us[at_fault] = 0.0
    elif fault == "late":
        felt_us[at_fault] = felt_us[at_fault - 1]
    noise_nm = lambda count: rng.normal(0.0, NOISE_SD_NM, count)  # noqa: E731
    generated = sampled(muscle, Design(felt_us, design.segment), RATE_HZ, noise_nm)
    pulse = np.minimum(np.floor(generated["time_s"] * 40 + 1e-9).astype(int), felt_us.size - 1)
    generated["pulse_width_us"] = design.width_us[pulse]
    if fault == "gap":
        generated = recorded(generated | {"truth": {"effects": [], "strength": "middle"}}, "gap", seed)
    return as_record(generated)


def look_at(job: Job) -> Row | None:
    """Diagnose the record of a job; None where it cannot be made."""
    workers.WORKERS = 1
    try:
        record, truth = make(job)
    except ValueError:
        return None
    cpu_s = time.process_time()
    search = search_record(record)
    verdict = judge(search)
    effects = {effect: {} for effect in search.names("detected")}
    effects |= {effect: each.scores for effect, each in examine(search).items()}
    return {
        "job": job, **truth,
        "verdict": verdict.kind, "probability": verdict.probability, "probabilities": verdict.probabilities,
        "scores": {"effects": effects, "left": scores_of_remainder(search)}, "cpu_s": time.process_time() - cpu_s,
    }  # fmt: skip


def statements(rows: Iterable[Row]) -> dict[str, list[tuple[Mapping[str, float], bool, str, bool]]]:
    """Return what was stated, by statement: its scores, whether it is true, the kind, and whether it is of the library.

    That something is left is true where not all that is hidden was named.
    """
    by: dict[str, list[Any]] = {"missing": [], "left": [], "seen": []}
    for row in rows:
        library = row["job"][0] != "physics" or row["job"][1] == "plain"
        for effect, scores in row["scores"]["effects"].items():
            statement = "missing" if scores else "seen"
            by[statement].append((scores, effect in row["true"], row["kind"], library))
        if row["more"] is not None:
            remaining = row["more"] or not {*row["true"]} <= row["scores"]["effects"].keys()
            by["left"].append((row["scores"]["left"], remaining, row["kind"], library))
    return by


def fit_weights(stated: list[Any]) -> dict[str, float]:
    """The logistic map from scores to probabilities that makes the truth most likely; no weight is negative."""
    names = list(stated[0][0])
    scores = np.array([[each[0][name] for name in names] for each in stated]).reshape(len(stated), len(names))
    true = np.array([each[1] for each in stated], float)

    def cost(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds = weights[0] + scores @ weights[1:]
        off = 1.0 / (1.0 + np.exp(-odds)) - true
        value = np.sum(np.logaddexp(0.0, odds) - true * odds) + 0.5 * RIDGE * np.sum(weights[1:] ** 2)
        return float(value), np.r_[np.sum(off), scores.T @ off + RIDGE * weights[1:]]

    bounds = [(None, None), *[(0.0, None)] * len(names)]
    solution = minimize(cost, np.zeros(len(names) + 1), jac=True, method="L-BFGS-B", bounds=bounds)
    return {name: round(float(weight), 3) for name, weight in zip(["", *names], solution.x, strict=True)}


def chances(stated: list[Any], weights: Mapping[str, float]) -> np.ndarray:
    """Probabilities of statements by a map."""
    return np.array([logistic(weights, scores) for scores, *_ in stated])


def chances_without_own_kind(stated: list[Any]) -> np.ndarray:
    """Probabilities of statements, each by a map that was made without its kind."""
    kinds, probabilities = np.array([each[2] for each in stated]), np.zeros(len(stated))
    for kind in {*kinds}:
        others = [each for each in stated if each[2] != kind]
        probabilities[kinds == kind] = chances([each for each in stated if each[2] == kind], fit_weights(others))
    return probabilities


def report(title: str, stated: list[Any], probabilities: np.ndarray) -> list[str]:
    """Lines of how well probabilities hold: by tenth the number, what was stated and the share that is true."""
    true = np.array([each[1] for each in stated], float)
    tenths = np.minimum((10 * probabilities).astype(int), 9)
    rows = [
        (
            f"{tenth / 10:.1f} to {(tenth + 1) / 10:.1f}",
            of_tenth.sum(),
            f"{probabilities[of_tenth].mean():.2f}",
            f"{true[of_tenth].mean():.2f}",
        )
        for tenth in range(10)
        if (of_tenth := tenths == tenth).any()
    ]
    confident = [
        f"{name} {int(true[of_tenth].sum())} of {of_tenth.sum()}"
        for name, kind in (("library's kinds", True), ("other physics", False))
        for of_tenth in [(probabilities >= SURE_PROBABILITY) & (np.array([each[3] for each in stated]) == kind)]
    ]
    brier = f"Brier score {np.mean((probabilities - true) ** 2):.3f}; of the base rate alone {np.var(true):.3f}."
    by_sure = f"True with {SURE_PROBABILITY} and more: {', '.join(confident)}."
    heads = ("stated", "statements", "mean stated", "true")
    return [f"### {title}", "", f"{brier} {by_sure}", "", *table(heads, rows), ""]


def main() -> None:
    """Diagnose the records, make the map or show how well it holds."""
    parser = argparse.ArgumentParser(prog="python -m bench.calibration", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--first", type=int, default=2000, help="first seed")
    parser.add_argument("--share", type=float, default=1.0, help="share of the records, from the first on")
    parser.add_argument("--json", type=Path, help="write the raw scores here")
    parser.add_argument("--scores", type=Path, nargs="+", help="do not diagnose: read the raw scores of earlier runs")
    parser.add_argument("--write", action="store_true", help="make the map of these scores")
    options = parser.parse_args()
    if options.scores:
        rows = [row for path in options.scores for row in json.loads(path.read_text())]
    else:
        todo = jobs(options.first)
        rows = []
        for row in in_processes(look_at, todo[: round(options.share * len(todo))]):
            rows += [row] if row is not None else []
            if len(rows) % 20 == 0:
                write_json(options.json, rows, None)
        write_json(options.json, rows, None)
    by = statements(rows)
    if options.write:
        weights = {statement: fit_weights(stated) for statement, stated in by.items()}
        generated = written_by("python -m bench.calibration --scores … --write")
        write_json(MAP, {"made": f"{generated} From {len(rows)} records.", "weights": weights})
    known = json.loads(MAP.read_text())["weights"]
    for statement, stated in by.items():
        print(*report(f"{statement}, by the map", stated, chances(stated, known[statement])), sep="\n")
        if statement != "seen":
            print(*report(f"{statement}, each kind left out", stated, chances_without_own_kind(stated)), sep="\n")


if __name__ == "__main__":
    main()
