"""The rig's protocols on the same simulated muscles: accuracy on unseen input, dose and time, beside the paper's test.

    python -m bench.protocols [--seeds 1000:1020] [--steep] [--noise-sd-nm 0.05]
    python -m bench.protocols --hidden [--strengths middle,strong] [--seeds 1100:1164]

Plain Hammerstein muscles of the emulator (`hardware_sim.hidden`), sampled at 400 Hz. Each protocol's record is
fitted; the model then predicts 30 s of levels that no protocol plays, without noise. Development used seeds below 100.
With `--hidden` each seed is a muscle with one hidden effect, in turn every effect in each strength, and every fourth
one a muscle without any; told is what the diagnosis of each protocol's record names. `--steep` has no part in that.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np

from bench.common import parser, seed_range, table
from bench.muscles.hidden_records import sampled
from stimrig.hardware_sim.hidden.design import Design, make_design
from stimrig.hardware_sim.hidden.library import STILL
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario, rng_of
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.fitting import fit
from stimrig.identify.records.record import Record
from stimrig.rig import limits, plan, protocols
from stimrig.rig.messages import Profile, TestPlan
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
        for protocol in protocols.LIBRARY:
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


def name_hidden(seeds: range, strengths: list[str], noise_sd_nm: float) -> list[dict[str, Any]]:
    """What the diagnosis names of each muscle, one row for each protocol."""
    workers.WORKERS = 1
    rows = []
    for seed in seeds:
        names, number = STILL, seed - seed // 4
        effect = names[number % len(names)] if seed % 4 else ""
        strength = strengths[number // len(names) % len(strengths)]
        scenario = draw_scenario((effect,) if effect else (), strength, seed, noise_sd_nm=noise_sd_nm)
        for protocol in protocols.LIBRARY:
            design = _design(protocol, float(np.floor(scenario.base.largest_width_us)))
            found = diagnose(_record(scenario, design, rng_of(seed, "noise", protocol), noise_sd_nm))
            rows.append({
                "seed": seed, "effect": effect, "strength": strength, "protocol": protocol, "verdict": found.verdict,
                "named": [entry["effect"] for entry in found.missing],
                "group": found.missing[0]["confused_with"] if found.missing else [],
            })  # fmt: skip
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def _told_of_hidden(rows: list[dict[str, Any]]) -> None:
    heads = "protocol, named first, and 'effect missing', or in its group, nothing named, nothing hidden: said so"
    lines = []
    for protocol in protocols.LIBRARY:
        of = [row for row in rows if row["protocol"] == protocol and row["effect"]]
        first = sum(row["named"][:1] == [row["effect"]] for row in of)
        sure = sum(row["named"][:1] == [row["effect"]] and row["verdict"] == "effect_missing" for row in of)
        group = sum(row["effect"] in [*row["named"][:1], *row["group"]] for row in of)
        nothing = sum(not row["named"] for row in of)
        plain = [row["verdict"] for row in rows if row["protocol"] == protocol and not row["effect"]]
        said = f"{plain.count('nothing_missing')} of {len(plain)}"
        lines.append([protocol, f"{first} of {len(of)}", sure, group, nothing, said])
    print(*table(heads.split(", "), lines), sep="\n")


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

    return as_record(sampled(scenario, design, RATE_HZ, noise_nm))


def _unseen(record: Record, truth: Record) -> float:
    """Best-fit percentage of the record's model on the unseen input."""
    predicted_nm = fit(record).predict(truth)
    error_nm = truth.torque_nm - predicted_nm
    return 100 * (1 - float(np.linalg.norm(error_nm) / np.linalg.norm(truth.torque_nm - truth.torque_nm.mean())))


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seeds", type=seed_range, default="1000:1020", help="first:last, last not included")
    made.add_argument("--steep", action="store_true", help="recruitment that rises within 5 to 25 µs")
    made.add_argument("--hidden", action="store_true", help="what the diagnosis names")
    made.add_argument("--strengths", default="middle,strong", help="of the hidden effects")
    made.add_argument("--noise-sd-nm", type=float, default=0.05)
    options = made.parse_args()
    if options.hidden:
        _told_of_hidden(name_hidden(options.seeds, options.strengths.split(","), options.noise_sd_nm))
        return
    rows = measure(options.seeds, options.steep, options.noise_sd_nm)
    paper_nms = np.array([row["torque_time_nms"] for row in rows if row["protocol"] == protocols.DEFAULT])
    lines = []
    for protocol in protocols.LIBRARY:
        of = [row for row in rows if row["protocol"] == protocol]
        dose = float(np.median([row["torque_time_nms"] for row in of] / paper_nms))
        fits = [row["unseen_fit"] for row in of]
        figures = (of[0]["duration_s"], dose, np.median(fits), min(fits))
        lines.append([protocol, *map(format, figures, (".1f", ".2f", ".2f", ".2f"))])
    print(*table(["protocol", "time s", "dose of the paper's", "unseen fit %, median", "lowest"], lines), sep="\n")


if __name__ == "__main__":
    main()
