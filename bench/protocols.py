"""The rig's protocols on the same simulated muscles: accuracy on unseen input, dose and time, beside the paper's test.

    python -m bench.protocols [--seeds 1000:1020] [--steep] [--noise-sd-nm 0.05] [--json]

Plain Hammerstein muscles of the emulator (`hardware_sim.patients.hidden`), sampled at 400 Hz. Each protocol's record is
fitted; the model then predicts 30 s of levels that no protocol plays, without noise. Development used seeds below 100.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np

from hardware_sim.hidden_records import sampled
from hardware_sim.patients.hidden.design import Design, make_design
from hardware_sim.patients.hidden.draw import Scenario, draw_scenario, rng_of
from identify.fitting import fit
from identify.records.record import Record
from rig import limits, plan, protocols
from rig.messages import Profile, TestPlan
from tests.harness.carried_sessions import as_record

RATE_HZ = 400.0
UNSEEN_S = 30.0


def measure(seeds: range, steep: bool, noise_sd_nm: float) -> list[dict[str, Any]]:
    """One row for each muscle and protocol."""
    rows = []
    for seed in seeds:
        scenario = draw_scenario((), "middle", seed, noise_sd_nm=noise_sd_nm, steep=steep)
        largest_us = float(np.floor(scenario.base.largest_width_us))
        unseen = make_design("full", rng_of(seed, "unseen"), largest_us, validate_s=UNSEEN_S, with_validate=True)
        held = unseen.held_out
        truth = _record(scenario, Design(unseen.width_us[held], unseen.segment[held]), None)
        for protocol in protocols.library():
            design = _design(protocol, largest_us)
            rng = rng_of(seed, "noise", protocol)
            record = _record(scenario, design, rng, noise_sd_nm)
            clean = _record(scenario, design, None)
            rows.append({
                "seed": seed, "protocol": protocol, "duration_s": design.duration_s,
                "torque_time_nms": float(np.sum(np.abs(clean.torque_nm)) / RATE_HZ),
                "unseen_fit": _unseen(record, truth),
            })  # fmt: skip
    return rows


def _design(protocol: str, largest_us: float) -> Design:
    """A protocol's pulses, as the rig builds them."""
    profile = Profile(max_pulse_width_us=largest_us)
    request = TestPlan(test_id="bench", participant="P", profile=profile, protocol=protocol)
    test = plan.build(request, limits.for_plan(limits.HARD_LIMITS, request))
    names = np.concatenate([np.full(s.end - s.start, s.name, dtype="<U20") for s in test.segments])
    return Design(np.floor(test.pulse_width_us), names)


def _record(scenario: Scenario, design: Design, rng: np.random.Generator | None, sd_nm: float = 0.0) -> Record:
    """The torque of a design; without `rng` without noise."""

    def noise_nm(count: int) -> np.ndarray:
        return np.zeros(count) if rng is None else sd_nm * rng.standard_normal(count)

    return as_record(sampled(scenario, design, RATE_HZ, 0.0, noise_nm))


def _unseen(record: Record, truth: Record) -> float:
    """Best-fit percentage of the record's model on the unseen input."""
    predicted_nm = fit(record).predict(truth)
    error_nm = truth.torque_nm - predicted_nm
    return 100 * (1 - float(np.linalg.norm(error_nm) / np.linalg.norm(truth.torque_nm - truth.torque_nm.mean())))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="1000:1020", help="first:last, last not included")
    parser.add_argument("--steep", action="store_true", help="recruitment that rises within 5 to 25 µs")
    parser.add_argument("--noise-sd-nm", type=float, default=0.05)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    rows = measure(range(first, last), options.steep, options.noise_sd_nm)
    if options.json:
        print(json.dumps(rows))
        return
    print("| protocol | time s | dose of the paper's | unseen fit %, median | lowest |\n|---|---|---|---|---|")
    paper_nms = np.array([row["torque_time_nms"] for row in rows if row["protocol"] == protocols.DEFAULT])
    for protocol in protocols.library():
        of = [row for row in rows if row["protocol"] == protocol]
        dose = float(np.median([row["torque_time_nms"] for row in of] / paper_nms))
        fits = [row["unseen_fit"] for row in of]
        print(f"| {protocol} | {of[0]['duration_s']:.1f} | {dose:.2f} | {np.median(fits):.2f} | {min(fits):.2f} |")


if __name__ == "__main__":
    main()
