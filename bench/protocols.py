"""Compare the rig's protocols on the same simulated muscles: accuracy on unseen input, dose and names of effects.

    python -m bench.protocols [--seeds 1000:1030] [--steep]
    python -m bench.protocols --hidden [--strengths middle,strong] [--seeds 1100:1132]

A model of each protocol's record, with white noise of 0.05 N·m at 400 Hz, predicts 30 s of levels that no protocol
plays, without noise. Muscles are plain; with `--hidden` each has one effect, in turn every one, and every fourth none,
and `diagnose` names them. Seeds below 100 were developed on.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np

from bench.common import bench_parser, table
from bench.muscles.hidden_records import sampled
from bench.muscles.physics_records import protocol_design
from stimrig import identify
from stimrig.hardware_sim.hidden.design import Design, make_design
from stimrig.hardware_sim.hidden.library import STILL
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario, rng_of
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.rig import protocols
from tests.harness.carried_sessions import as_record

RATE_HZ, NOISE_SD_NM, UNSEEN_S = 400.0, 0.05, 30.0


def record_of(scenario: Scenario, design: Design, noise: np.random.Generator | None) -> identify.Record:
    """Return the record of a design, with noise where a generator is passed."""
    return as_record(
        sampled(scenario, design, RATE_HZ, lambda n: np.zeros(n) if noise is None else noise.normal(0, NOISE_SD_NM, n))
    )


def accuracy_lines(seeds: range, steep: bool) -> list[str]:
    """Return the table of unseen fits and doses."""
    fits: dict[str, list[float]] = {name: [] for name in protocols.LIBRARY}
    doses: dict[str, list[float]] = {name: [] for name in protocols.LIBRARY}
    durations_s = {}
    for seed in seeds:
        scenario = draw_scenario((), "middle", seed, noise_sd_nm=NOISE_SD_NM, steep=steep)
        largest_us = float(np.floor(scenario.base.largest_width_us))
        unseen = make_design("full", rng_of(seed, "unseen"), largest_us, validate_s=UNSEEN_S)
        truth = record_of(scenario, Design(unseen.width_us[unseen.held_out], unseen.segment[unseen.held_out]), None)
        for name in protocols.LIBRARY:
            design = protocol_design(name, largest_us)
            durations_s[name] = design.duration_s
            doses[name].append(float(np.sum(np.abs(record_of(scenario, design, None).torque_nm))))
            model = identify.fit(record_of(scenario, design, rng_of(seed, "noise", name)))
            fits[name].append(best_fit_percent(truth.torque_nm, identify.predict(model, truth)))
    rows = []
    for name in protocols.LIBRARY:
        dose = np.array(doses[name]) / np.array(doses["paper"])
        figures = (np.median(dose), dose.max(), np.median(fits[name]), min(fits[name]))
        rows.append([name, f"{durations_s[name]:.1f}", *(f"{figure:.2f}" for figure in figures)])
    return table(["protocol", "time s", "dose of the paper's", "highest", "unseen fit %, median", "lowest"], rows)


def hidden_lines(seeds: range, strengths: list[str]) -> list[str]:
    """Return the table of what `diagnose` names."""
    workers.WORKERS = 1
    diagnoses_of: dict[str, list[tuple[str, Any]]] = {name: [] for name in protocols.LIBRARY}
    for seed in seeds:
        number = seed - seed // 4
        effect = STILL[number % len(STILL)] if seed % 4 else ""
        strength = strengths[number // len(STILL) % len(strengths)]
        scenario = draw_scenario((effect,) if effect else (), strength, seed, noise_sd_nm=NOISE_SD_NM)
        for name in protocols.LIBRARY:
            design = protocol_design(name, float(np.floor(scenario.base.largest_width_us)))
            diagnosis = identify.diagnose(record_of(scenario, design, rng_of(seed, "noise", name)))
            diagnoses_of[name].append((effect, diagnosis))
            first = [entry["effect"] for entry in diagnosis.missing]
            print(json.dumps([seed, effect, strength, name, diagnosis.verdict, first]), file=sys.stderr, flush=True)
    rows = []
    for name, diagnoses in diagnoses_of.items():
        hidden = [(effect, each.verdict, each.missing[:1]) for effect, each in diagnoses if effect]
        plain = [each.verdict for effect, each in diagnoses if not effect]
        right = [verdict for effect, verdict, first in hidden if first and first[0]["effect"] == effect]
        group = sum(effect in {first[0]["effect"], *first[0]["confused_with"]} for effect, _, first in hidden if first)
        nothing = f"{plain.count('nothing_missing')} of {len(plain)}"
        sure = right.count("effect_missing")
        rows.append([name, f"{len(right)} of {len(hidden)}", sure, group, sum(not row[2] for row in hidden), nothing])
    heads = "protocol, named first, and 'effect missing', or in its group, nothing named, nothing hidden: said so"
    return table(heads.split(", "), rows)


def main() -> None:
    """Measure and print."""
    parser = bench_parser(__doc__, "1000:1030")
    parser.add_argument("--steep", action="store_true", help="recruitment that rises within 5 to 25 µs")
    parser.add_argument("--hidden", action="store_true", help="what the diagnosis names; not with --steep")
    parser.add_argument("--strengths", default="middle,strong", help="of the hidden effects")
    options = parser.parse_args()
    lines = hidden_lines(options.seeds, options.strengths.split(",")) if options.hidden else None
    print(*(lines or accuracy_lines(options.seeds, options.steep)), sep="\n")


if __name__ == "__main__":
    main()
