"""What the slow states of an approved model's effects are worth in tracking: with them, and begun rested in each trial.

    python -m bench.tracking_states [--seeds 94020:94040] [--json FILE]

The muscles are those of `bench.tracking_cases`, with laws of their own. The paper's test, a model fitted on it with the
effect, a minute, then ten trials: with rests of 15 s, or with rests drawn between 5 and 180 s. Told is how far the
torque of each trial is from what the model served before it says, rms, % of the torque's rms.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import identify
from bench.adaptive import paper_test
from bench.tracking import LARGEST_US, PER, Person
from bench.tracking_cases import CASES, PEAK_SHARE
from identify.model import Model
from identify.records.record import Record
from identify.tracking import begin, follow, model_for_next, moved_model
from identify.tracking.carried import rested, with_states

TRIALS, REST_S, SHORTEST_S, LONGEST_S, APPROVAL_S = 10, 15.0, 5.0, 180.0, 60.0
OWN: dict[str, dict[str, float]] = {
    "fatigue": {"fatigue_share": 0.55, "fatigue_recovery_s": 600.0},
    "quick fatigue": {"fatigue_share": 0.5, "fatigue_recovery_s": 90.0},
    "potentiation": {"potentiation_share": 0.4, "potentiation_recovery_s": 60.0},
}
RESTED, CARRIED, TOLD = "begun rested", "carried", "carried, the rest told"


def trial_widths(model: Model) -> np.ndarray:
    """Moves and holds up to a share of the plateau by the approved curve alone, with a second of rest at both ends."""
    inverse = model.to_dict()["recruitment"]["inverse"]
    level, width = np.abs(inverse["torque_nm"]), np.array(inverse["pulse_width_us"])
    order = np.argsort(level)
    steps = PEAK_SHARE * level.max() * np.array([0.0, 0.5, 0.5, 1.0, 1.0, 0.15, 0.15])
    wanted = np.interp(np.linspace(0.0, 6.0, 400), np.arange(7.0), steps)
    return np.r_[np.zeros(40), np.round(np.interp(wanted, level[order], width[order])), np.zeros(40)]


def error_percent(model: Model, trial: Record) -> float:
    """Of the mean torque in each pulse's period, above the rest before."""
    seen, said = (x.reshape(-1, PER).mean(axis=1) for x in (trial.torque_nm, model.predict(trial)))
    seen, said = seen - seen[:40].mean(), said - said[:40].mean()
    return 100.0 * float(np.sqrt(np.mean((seen - said) ** 2) / np.mean(seen**2)))


def session(seed: int, case: str, uneven: bool) -> dict[str, Any]:
    """Errors of each trial by who foretold it."""
    CASES[case] = OWN[case]
    person, rng = Person(seed, case), np.random.default_rng([seed, 77])
    test = person.play(*paper_test(LARGEST_US, held_out=True))
    model = identify.fit(test, effects=[case.removeprefix("quick ")])
    widths, errors = trial_widths(model), {name: [] for name in (RESTED, CARRIED, TOLD)}
    forgot, carried = begin(model), begin(model, test=test)
    served = {RESTED: model, CARRIED: with_states(model, rested(model, carried.effects, APPROVAL_S))}
    for number in range(TRIALS):
        drawn_s = float(np.exp(rng.uniform(math.log(SHORTEST_S), math.log(LONGEST_S)))) if uneven else REST_S
        rest_s = drawn_s if number else APPROVAL_S
        person.now_s += rest_s
        trial = person.play(widths, ["trial"] * widths.size)
        served[TOLD] = with_states(served[CARRIED], rested(model, carried.effects, rest_s))
        for name, one in served.items():
            errors[name].append(error_percent(one, trial))
        step = follow(model, carried, trial, rest_s=rest_s)
        carried, served[CARRIED] = step.coming, model_for_next(model, step)
        forgot = replace(follow(model, forgot, trial, rest_s=math.inf).coming, effects={})
        served[RESTED] = moved_model(model, forgot.values, forgot.curve_nm)
    return {"seed": seed, "case": case, "uneven": uneven, "errors": errors}


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Medians over the muscles, and in how many sessions it was worse than begun rested."""
    lines = ["| case | rests | served | trial 1 | trial 2 | trials 3 to 10 | session | worse in |", "|---" * 8 + "|"]
    for case, uneven in dict.fromkeys((row["case"], row["uneven"]) for row in rows):
        found = [row["errors"] for row in rows if (row["case"], row["uneven"]) == (case, uneven)]
        whole = {name: np.sqrt(np.mean([np.square(one[name]) for one in found], axis=1)) for name in found[0]}
        for name, session_rms in whole.items():
            errors, ratio = np.array([one[name] for one in found]), session_rms / whole[RESTED]
            parts = (errors[:, 0], errors[:, 1], errors[:, 2:], session_rms)
            lines.append(
                f"| {case} | {'drawn' if uneven else 'even'} | {name} | "
                + " | ".join(f"{np.median(part):.1f} %" for part in parts)
                + f" | {np.sum(ratio > 1.0)} of {ratio.size}, × {ratio.max():.2f} at most |"
            )
    return lines


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.tracking_states", description=__doc__)
    parser.add_argument("--seeds", default="94020:94040", help="first:end")
    parser.add_argument("--json", type=Path, help="every row goes here, one a line")
    options = parser.parse_args()
    seeds = range(*map(int, options.seeds.split(":")))
    rows = [session(seed, case, uneven) for seed in seeds for case in OWN for uneven in (False, True)]
    if options.json is not None:
        options.json.write_text("\n".join(json.dumps(row) for row in rows))
    print(*table(rows), sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
