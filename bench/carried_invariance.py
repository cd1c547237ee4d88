"""What is said of a carried structure if the same session is recorded in another way; see docs/diagnosis.md.

    python -m bench.carried_invariance --seeds 5141:5151 [--json FILE]

Muscles and second sessions are those of `bench.carried`. Each session is simulated once, with its noise, at 1600 Hz.
The reference is every eighth sample. The changes are other zeros, signs, scales and times, other samples of the same
session, and the earlier model's effects in another order. Seeds 5131 to 5140 were developed on.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bench.common import keep, parser, table
from stimrig import identify
from stimrig.hardware_sim.hidden.scenario import rng_of
from stimrig.hardware_sim.hidden_records import SLOWEST_SIMULATION_HZ
from tests.harness.carried_sessions import SESSIONS, as_record, fine_session, muscle, session

REFERENCE_EVERY = 8
"""Samples of the simulation, at 1600 Hz, to one of the reference, at 200 Hz."""
JITTER_SD_S, JITTER_MOST_S = 5e-4, 1.875e-3
Columns = dict[str, Any]


def rows(every: int) -> Callable[[Columns, np.random.Generator], Columns]:
    """Every n-th sample."""
    return lambda fine, _: {name: column[::every] for name, column in fine.items()}


def of_torque(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Columns, np.random.Generator], Columns]:
    """The reference with another torque."""

    def changed(fine: Columns, rng: np.random.Generator) -> Columns:
        found = reference(fine, rng)
        return found | {"torque_nm": change(found["torque_nm"])}

    return changed


def later(fine: Columns, rng: np.random.Generator) -> Columns:
    """The reference, its clock 12345.678 s ahead."""
    found = reference(fine, rng)
    return found | {"time_s": found["time_s"] + 12345.678}


def jittered(told: bool) -> Callable[[Columns, np.random.Generator], Columns]:
    """Samples that are taken early or late, with time stamps that tell so or with even ones."""

    def changed(fine: Columns, rng: np.random.Generator) -> Columns:
        even = np.arange(fine["time_s"].size)[::REFERENCE_EVERY]
        off_s = np.clip(rng.normal(0.0, JITTER_SD_S, even.size), -JITTER_MOST_S, JITTER_MOST_S)
        taken = np.clip(even + np.rint(off_s * SLOWEST_SIMULATION_HZ).astype(int), 0, fine["time_s"].size - 1)
        found = {name: column[taken] for name, column in fine.items()}
        return found if told else found | {"time_s": fine["time_s"][even]}

    return changed


def dead_time(late_s: float) -> Callable[[Columns, np.random.Generator], Columns]:
    """The reference, its torque this much late."""
    late = round(late_s * SLOWEST_SIMULATION_HZ)

    def changed(fine: Columns, rng: np.random.Generator) -> Columns:
        torque_nm = fine["torque_nm"]
        delayed = torque_nm[np.maximum(np.arange(torque_nm.size) - late, 0)]
        return reference(fine | {"torque_nm": delayed}, rng)

    return changed


reference = rows(REFERENCE_EVERY)
CHANGES: dict[str, Callable[[Columns, np.random.Generator], Columns]] = {
    "torque 37 N·m higher": of_torque(lambda y: y + 37.0),
    "torque 37 N·m lower": of_torque(lambda y: y - 37.0),
    "time 12345.678 s later": later,
    "torque with the other sign": of_torque(lambda y: -y),
    "torque × 0.1": of_torque(lambda y: 0.1 * y),
    "torque × 10": of_torque(lambda y: 10.0 * y),
    "sampled at 100 Hz instead of 200": rows(2 * REFERENCE_EVERY),
    "sampled at 400 Hz": rows(REFERENCE_EVERY // 2),
    "clock jitter of 0.5 ms, in the time stamps": jittered(told=True),
    "clock jitter of 0.5 ms, not in the time stamps": jittered(told=False),
    "torque 2.5 ms late": dead_time(2.5e-3),
    "torque 5 ms late": dead_time(5e-3),
}
REVERSED = "the earlier model's effects in the other order"


def said(record: identify.Record, approved: identify.Model) -> dict[str, Any]:
    """The answer, without its figures and in no order; the figures beside it."""
    found = identify.carry(record, approved)
    answer = [found.offered, *(sorted(part) for part in (found.still_needed, found.no_longer_needed, found.undecided))]
    return {"answer": answer, "gains": {row["effect"]: row["log_evidence_gain"] for row in found.effects}}


def one(seed: int) -> list[dict[str, Any]]:
    """The answers of one muscle: a row for each second session and change."""
    of = muscle(seed)
    names = [hidden.effect for hidden in of.hidden]
    approved = identify.fit(session(of, seed, "first", (0, 1)), effects=names[:2])
    turned = replace(approved, effects=approved.effects[::-1])
    found = []
    for label in SESSIONS:
        fine = fine_session(of, seed, label)
        plain = as_record(reference(fine, rng_of(seed, "none")))
        answers = {"": said(plain, approved), REVERSED: said(plain, turned)}
        for name, change in CHANGES.items():
            answers[name] = said(as_record(change(fine, rng_of(seed, "recorded", label, name))), approved)
        found += [
            {"seed": seed, "session": label, "effects": names, "change": name, **answer}
            | {"same": answer["answer"] == answers[""]["answer"], "reference": answers[""]}
            for name, answer in answers.items()
            if name
        ]
    return found


def main() -> None:
    """Print how many answers and how many muscles changed."""
    options = parser(__doc__, "5141:5151").parse_args()
    found: list[dict[str, Any]] = []
    for seed in options.seeds:
        found += one(seed)
        print(*(json.dumps(row) for row in found if row["seed"] == seed and not row["same"]), sep="\n", file=sys.stderr)
    lines = []
    for change in (*CHANGES, REVERSED):
        of_change = [row for row in found if row["change"] == change]
        other = [row for row in of_change if not row["same"]]
        lines.append([change, f"{len(other)} of {len(of_change)}", len({row["seed"] for row in other})])
    print(*table(["change", "sessions with another answer", "muscles with one"], lines), sep="\n")
    keep(options.json, found)


if __name__ == "__main__":
    main()
