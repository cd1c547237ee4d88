"""The controller of `examples/ilc_two_muscles.py` on simulated joints of two muscles; see docs/controllers.md.

    python -m bench.ilc_two_muscles --seeds 1000:1020 [--trials 10] [--json FILE]

Each joint is drawn by its seed, with cross-talk, co-contraction and fatigue as it happens to have them. A record of
50 s gives the model. Then ten trials, with noise, and the fatigue of all trials before. Beside them one trial of the
widths that `muscles.invert` finds with the whole model. Seeds 0 to 99 were developed on.
"""

from __future__ import annotations

import contextlib
import io
import sys
from typing import Any

import numpy as np

from bench.common import ROOT, in_processes, keep, parser, table, written_by
from stimrig.hardware_sim.joint import Joint as Truth
from stimrig.hardware_sim.joint_records import draw_joint, record
from stimrig.identify import muscles
from stimrig.identify.errors import IdentifyError
from stimrig.identify.muscles.finish import finished
from stimrig.identify.muscles.joint_fit import fit_all
from stimrig.identify.muscles.problem import Acting

sys.path.insert(0, str(ROOT / "examples"))
from ilc_two_muscles import CO_CONTRACTIONS, Joint, learn_joint, reachable

NAMES = ("agonist", "antagonist")
OFFSET_S, PULSES_HZ, RATE_HZ = 0.0125, 40, 400
NOISE_NM = 0.05
BEFORE, BETWEEN = 40, 400
"""Pulses of rest before a trial, and between two."""
RISE_US = 50.0
INTERPLAY = [f"cross_talk:{NAMES[0]}>{NAMES[1]}", f"cross_talk:{NAMES[1]}>{NAMES[0]}", "co_contraction"]
ENOUGH = 3.0
"""Gain of the log evidence for which an interplay is added."""
RUNS: dict[str, dict[str, Any]] = {
    **{f"both, {one}": {"co_contraction": one} for one in CO_CONTRACTIONS},
    **{f"{one} alone": {"only": one} for one in NAMES},
}


def test_of(joint: Truth, seed: int) -> muscles.JointRecord:
    """One test: each muscle alone, then both at levels of their own, then the same held out."""
    rng = np.random.default_rng([seed, 77])

    def alone() -> np.ndarray:
        steps = np.repeat(rng.integers(0, 2, 60), 6)[:320] * rng.choice([0.5, 0.75, 1.0])
        up = np.linspace(0, 1, 120, endpoint=False)
        return np.r_[steps, np.zeros(60), up, 1 - up, np.zeros(60)]

    def levels(count: int) -> np.ndarray:
        return np.repeat(rng.uniform(0.2, 1, (2, count)) * (rng.random((2, count)) > 0.25), 20, axis=1)

    first, second = alone(), alone()
    turns = np.stack([np.r_[first, np.zeros(second.size)], np.r_[np.zeros(first.size), second]])
    rest, both, held_out = np.zeros((2, 40)), levels(14), levels(12)
    widths = np.hstack([rest, turns, both, rest, held_out, rest])
    parts = [("rest", rest), ("train", turns), ("train", both), ("rest", rest), ("validate", held_out), ("rest", rest)]
    segment = np.concatenate([[name] * part.shape[1] for name, part in parts])
    largest = np.array([one.largest_width_us for one in joint.muscles])
    told = record(joint, *np.round(widths * largest[:, None]), noise_sd_nm=NOISE_NM, seed=seed, rate_hz=200)
    place = np.minimum((told["time_s"] * PULSES_HZ + 1e-9).astype(int), segment.size - 1)
    channels = muscles.Channel(NAMES[0]), muscles.Channel(NAMES[1], offset_s=OFFSET_S)
    held = dict(zip(NAMES, (told["first_us"], told["second_us"]), strict=True))
    return muscles.JointRecord.from_arrays(channels, told["time_s"], held, told["torque_nm"], segment[place])


def identified(test: muscles.JointRecord) -> muscles.JointModel:
    """The plain structure, and what interplay the evidence asks for: `muscles.improve` without effects, for speed."""
    found = fit_all(test)
    while True:
        there = {acting.key(NAMES) for acting in found.acting}
        left = [Acting.of(text, NAMES) for text in INTERPLAY if text not in there]
        forms = [Acting(one.interplay, form.name, one.between) for one in left for form in one.interplay.forms]
        tried = [found.with_(acting=[*found.acting, one]) for one in forms]
        best = max(tried, key=lambda each: each.fitted.log_evidence, default=found)
        if best.fitted.log_evidence < found.fitted.log_evidence + ENOUGH:
            return finished(found)
        found = best


class Person:
    """Stands where the service stands: plays trials on a joint that remembers all of them; counts broken limits."""

    def __init__(self, joint: Truth, seed: int) -> None:
        self.joint, self.seed, self.trials, self.broken = joint, seed, 0, 0
        self.before = np.zeros((2, 0))

    def play_joint(self, widths_us: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """A trial, after a rest."""
        size = next(iter(widths_us.values())).size
        widths = np.stack([widths_us.get(name, np.zeros(size)) for name in NAMES])
        for own, one in zip(widths, self.joint.muscles, strict=True):
            rises = np.diff(np.r_[0.0, own])
            self.broken += int(np.sum((own > one.largest_width_us) | (own != np.round(own)) | (rises > RISE_US)))
        self.before = np.hstack([self.before, np.zeros((2, BETWEEN)), widths])
        self.trials += 1
        told = record(
            self.joint, *self.before, noise_sd_nm=NOISE_NM, seed=1000 * self.trials + self.seed, rate_hz=RATE_HZ
        )
        each = RATE_HZ // PULSES_HZ
        means = told["torque_nm"].reshape(-1, each).mean(axis=1)
        return means[-size:] - means[-size - BEFORE : -size].mean(), widths_us


def one(job: tuple[int, int]) -> dict[str, Any]:
    """All ways on one joint, each from a rested one: tracking error of each trial, % of the reference's range."""
    seed, trials = job
    truth = draw_joint(seed)
    fitted = identified(test_of(truth, seed))
    model = fitted.to_dict()
    reference_nm = reachable(model)
    try:
        Joint(model, reference_nm)
    except ValueError as error:  # the fit has a muscle pull the wrong way
        return {"seed": seed, "refused": str(error)}
    found: dict[str, Any] = {"seed": seed, "broken": 0, "errors": {}}
    for choice in CO_CONTRACTIONS:
        person = Person(truth, seed)
        limits = muscles.Limits(rise_us=RISE_US)
        try:
            planned = muscles.invert(fitted, reference_nm, co_contraction=choice, limits=limits)
        except IdentifyError as error:  # a curve that dips by more than it rises has no side
            print(f"seed {seed}: {error}", file=sys.stderr)
            found["errors"][f"`invert`, {choice}"] = [np.inf]
            continue
        error_nm = reference_nm - person.play_joint(planned.pulse_width_us)[0]
        found["errors"][f"`invert`, {choice}"] = [100 * float(np.sqrt(np.mean(error_nm**2)) / np.ptp(reference_nm))]
        found["broken"] += person.broken
    for name, told in RUNS.items():
        person = Person(truth, seed)
        with contextlib.redirect_stderr(io.StringIO()):
            done = learn_joint(person, Joint(model, reference_nm, **told), trials)
        found["errors"][name] = [trial.error_percent for trial in done]
        found["broken"] += person.broken
    return found


def main() -> None:
    """Run, and print a table."""
    made = parser(__doc__, "1000:1020")
    made.add_argument("--trials", type=int, default=10)
    options = made.parse_args()
    rows = []
    for row in in_processes(one, [(seed, options.trials) for seed in options.seeds]):
        if "refused" in row:
            print(f"seed {row['seed']} refused: {row['refused']}")
            continue
        rows.append(row)
        last = "  ".join(f"{name} {errors[0]:.1f}>{errors[-1]:.2f}" for name, errors in row["errors"].items())
        print(f"seed {row['seed']}: {last}", file=sys.stderr, flush=True)
    seeds = f"{options.seeds.start}:{options.seeds.stop}"
    print(written_by(f"python -m bench.ilc_two_muscles --seeds {seeds} --trials {options.trials}"))
    print(
        f"Error in % of the reference's range, {len(rows)} joints. Limits broken: {sum(row['broken'] for row in rows)}."
    )
    lines = []
    for name in rows[0]["errors"]:
        errors = np.array([row["errors"][name] for row in rows])
        last = errors.shape[1] - 1
        cells = [f"{np.median(errors[:, at]):.2f}" if at <= last else "" for at in (0, 1, 4, options.trials - 1)]
        lines.append([name, *cells, f"{errors[:, -1].max():.2f}", int(np.sum(errors[:, -1] <= 3.0))])
    heads = ["", "trial 1", "2", "5", f"{options.trials}", "worst at the last", "at most 3 %"]
    print("\n".join(table(heads, lines)))
    keep(options.json, rows)


if __name__ == "__main__":
    main()
