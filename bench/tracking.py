"""Following a muscle that changes from trial to trial, on simulated sessions without waiting.

    python -m bench.tracking [--seeds 94000:94020] [--cases fatigue …] [--json FILE]

For each muscle, drawn by its seed, and each case of `CASES`: the paper's test, a model fitted on it, a minute of rest,
then ten trials of `examples/ilc_controller.py` with 15 s of rest between them, with tracking and without, each time
from the same state of the muscle and with the same noise. Printed is the error of a trial, rms of reference minus
torque, % of the reference's rms.
"""

from __future__ import annotations

import contextlib
import copy
import io
import sys
import time
from itertools import pairwise
from typing import Any

import numpy as np

from bench.adaptive import paper_test
from bench.common import bench_parser, table, write_json_lines
from bench.muscles.offline import simulate
from examples import ilc_controller as ilc
from stimrig import identify
from stimrig.hardware_sim import patients
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.tracking import follow, model_for_next
from stimrig.identify.tracking.state import QUANTITIES

RATE_HZ, NOISE_NM, CURRENT_MA, LARGEST_US = 400.0, 0.05, 20.0, 300.0
TRIALS, REST_S, APPROVAL_S = 10, 15.0, 60.0
PER = round(RATE_HZ / ilc.PULSE_RATE_HZ)
FIRST_TRIAL = 2
"""The pre-session test is a muscle's first contraction."""
NOTHING = "nothing changes"
TRACKED, UNTRACKED = "tracking", "no tracking"
DISTURBED_TRIAL = 5
PEAK_SHARE = 0.4
"""The reference's peak, of the largest torque: a muscle that has lost 40 % of it can still reach it."""

# The test before the trials tires, too: with this share of fatigue 40 % of the gain are lost from the begin of the
# first trial to the end of the tenth.
CASES = {
    NOTHING: {},
    "fatigue": {"fatigue_share": 0.55, "fatigue_recovery_s": 600.0},
    "potentiation": {"potentiation_share": 0.3},
    "threshold drift": {"drift_us": 15.0},
    "slow change of speed": {"slowing_share": 0.3},
    "spasm in trial 5": {"spasm_contraction": FIRST_TRIAL + DISTURBED_TRIAL - 1},
    "effort in trial 5": {"effort_contraction": FIRST_TRIAL + DISTURBED_TRIAL - 1},
}


def patient(seed: int, case: str) -> dict[str, Any]:
    """Parameters of `hardware_sim.patients.changing` for a muscle and a case; the muscle is the same in each case."""
    rng = np.random.default_rng([seed, 14])
    largest_nm = float(rng.uniform(3.0, 12.0))
    muscle = {
        "largest_nm": largest_nm,
        "threshold_us": float(rng.uniform(40.0, 110.0)),
        "spread_us": float(rng.uniform(50.0, 120.0)),
        "shape": float(rng.uniform(1.3, 3.0)),
        "natural_period_s": float(rng.uniform(0.12, 0.45)),
        "damping_ratio": float(rng.uniform(0.6, 1.1)),
        "spasm_nm": largest_nm * float(rng.uniform(0.15, 0.4)),
        "spasm_begins_s": float(rng.uniform(2.0, 8.0)),
        "spasm_lasts_s": float(rng.uniform(0.2, 1.5)),
        "effort_nm": largest_nm * float(rng.uniform(0.1, 0.25)),
        "effort_begins_s": float(rng.uniform(1.0, 5.0)),
        "effort_lasts_s": float(rng.uniform(2.0, 5.0)),
    }
    sign = 1.0 if rng.random() < 0.7 else -1.0
    changes = {name: sign * value if name == "drift_us" else value for name, value in CASES[case].items()}
    return muscle | changes


class Person:
    """A muscle on its own clock, and the noise of its sensor."""

    def __init__(self, seed: int, case: str) -> None:
        self.muscle = patients.make("changing", patient(seed, case))
        self.rng = np.random.default_rng([seed, 15])
        self.now_s = 0.0

    def play(self, widths_us: np.ndarray, names: list[str]) -> Record:
        """The record of such pulses, from now on."""
        span_s = widths_us.size / ilc.PULSE_RATE_HZ
        times = self.now_s + np.arange(widths_us.size) / ilc.PULSE_RATE_HZ
        clean = simulate(self.muscle, times, widths_us, CURRENT_MA, RATE_HZ, span_s, self.now_s)
        self.now_s += span_s
        noisy = clean + NOISE_NM * self.rng.standard_normal(clean.size)
        held_us = np.repeat(widths_us, PER)
        return Record.from_arrays(np.arange(clean.size) / RATE_HZ, held_us, noisy, np.repeat(names, PER))


class Simulated:
    """Takes the place of the service for `ilc.learn`; it follows `model` from trial to trial."""

    def __init__(self, person: Person, model: Model) -> None:
        self.person, self.model, self.state = person, model, None
        self.record: Record | None = None
        self.served: list[dict[str, Any]] = []
        self.seconds: list[float] = []

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A trial with its rests, after the rest before it."""
        self.person.now_s += REST_S
        before, after = round(ilc.BEFORE_S * ilc.PULSE_RATE_HZ), round(ilc.AFTER_S * ilc.PULSE_RATE_HZ)
        names = ["rest"] * before + ["trial"] * widths_us.size + ["rest"] * after
        self.record = self.person.play(np.r_[np.zeros(before), widths_us, np.zeros(after)], names)
        torque = self.record.torque_nm.reshape(-1, PER)
        baseline_nm = torque[round(0.3 * before) : before].mean()
        return torque[before : before + widths_us.size].mean(axis=1) - baseline_nm, widths_us

    def fetch_followed(self) -> dict[str, Any]:
        """The model after the trial just played, as the service makes it from the recording."""
        assert self.record is not None
        began = time.perf_counter()
        step = follow(self.model, self.state, self.record)
        self.state = step.coming
        served = step.to_dict() | {"moved": list(QUANTITIES)}
        document = model_for_next(self.model, step).to_dict() | {"tracking": served}
        self.seconds.append(time.perf_counter() - began)
        self.served.append(served)
        return document


def run_sessions(seed: int, case: str) -> list[dict[str, Any]]:
    """Run the sessions with and without tracking on this muscle."""
    person = Person(seed, case)
    test = person.play(*paper_test(LARGEST_US, held_out=True))
    person.now_s += APPROVAL_S
    model = identify.fit(test)
    document = model.to_dict()
    reference = ilc.Reference.reach(PEAK_SHARE * float(document["recruitment"]["inverse"]["torque_nm"][-1]))
    return [{"seed": seed, "case": case} | session(copy.deepcopy(person), model, reference, tracked)
            for tracked in (True, False)]  # fmt: skip


def session(person: Person, model: Model, reference: ilc.Reference, tracked: bool) -> dict[str, Any]:
    """Ten trials."""
    service: Any = Simulated(person, model)
    with contextlib.redirect_stderr(io.StringIO()):
        done = ilc.learn(service, model.to_dict(), reference, "norm-optimal", TRIALS, tracked=tracked)
    return {
        "who": TRACKED if tracked else UNTRACKED,
        "errors": [trial.error_percent for trial in done],
        "seconds": service.seconds,
        "moves": moves(service.served),
    }


def moves(served: list[dict[str, Any]]) -> list[list[float]]:
    """Return the change of the expected quantities by each trial, in half widths of the band before it.

    One row a trial, from the second on: gain, threshold, time scale.
    """
    shifts = []
    for before, after in pairwise(served):
        if not before or not after:
            continue
        shifts.append([
            abs(after["coming"][name]["value"] - before["coming"][name]["value"])
            / max((before["coming"][name]["high"] - before["coming"][name]["low"]) / 2, 1e-12)
            for name in ilc.TRACKED
        ])  # fmt: skip
    return shifts


def tables(rows: list[dict[str, Any]]) -> list[str]:
    """Errors of the tenth trial, and their ratio to that of the same muscle when nothing changes."""
    names = list(dict.fromkeys(row["who"] for row in rows))
    last = {(row["seed"], row["case"], row["who"]): float(row["errors"][-1]) for row in rows}
    muscles = {name: len({key[0] for key in last if key[2] == name}) for name in names}
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        cells = []
        for name in names:
            keys = [key for key in last if key[1:] == (case, name)]
            errors = np.array([last[key] for key in keys])
            still = np.array([last.get((key[0], NOTHING, name), np.nan) for key in keys])
            if not errors.size:
                cells.append("")
                continue
            cell = f"{np.median(errors):.2f} %"
            if np.isfinite(still).any():
                median, p90 = np.nanquantile(errors / still, [0.5, 0.9])
                cell += f" (× {median:.2f}, {p90:.2f})"
            cells.append(cell)
        lines.append([case, *cells])
    return table(["case", *(f"{name}, n = {muscles[name]}" for name in names)], lines)


def seconds_of(rows: list[dict[str, Any]]) -> list[str]:
    """Time that following a trial took."""
    lines = []
    for name in dict.fromkeys(row["who"] for row in rows if row["seconds"]):
        durations_s = np.concatenate([row["seconds"] for row in rows if row["who"] == name])
        median_ms, p99_ms = 1e3 * np.quantile(durations_s, [0.5, 0.99])
        lines.append(f"{name}: {median_ms:.0f} ms in the middle, p99 {p99_ms:.0f} ms, n = {durations_s.size}")
    return lines


def moved_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return for each case the share of trials that moved a served quantity by more than its band."""
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        case_moves = [row["moves"] for row in rows if row["case"] == case and row["who"] == TRACKED and row["moves"]]
        if case_moves:
            moved = np.concatenate(case_moves)
            beyond = np.mean(np.any(moved > 1.0, axis=1))
            lines.append(
                f"{case}: {100 * beyond:.1f} % of {len(moved)} trials moved beyond a band; largest, in bands: "
                + ", ".join(f"{name} {value:.2f}" for name, value in zip(ilc.TRACKED, moved.max(axis=0), strict=True))
            )
    return lines


def main() -> None:
    """Print the tables."""
    parser = bench_parser(__doc__, "94000:94020")
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for seed in options.seeds:
        for case in options.cases:
            rows += run_sessions(seed, case)
        print(f"seed {seed}", file=sys.stderr, flush=True)
        write_json_lines(options.json, rows)
    print(*tables(rows), "", *seconds_of(rows), "", *moved_lines(rows), sep="\n")


if __name__ == "__main__":
    main()
