"""An adaptive test of two muscles against the fixed one: its time, the dose of each muscle, the error on unseen pulses.

    python -m bench.adaptive_several --seeds 1200:1212 [--noise 0.05] [--target 2] [--plain] [--json FILE]

Emulated joints by seed, with the fixed test and the unseen record of `bench.two_muscles`, in which both muscles move.
It may take as long as the fixed one without its held-out levels, and give each muscle as much torque-time
and as many microseconds. Both records get the same search, or with `--plain` the fit that decides.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from bench.common import in_processes, keep, parser, table
from bench.two_muscles import NAMES, PULSES_HZ, as_record, rms, unseen_widths, widths
from stimrig.hardware_sim.joint_records import draw_joint
from stimrig.hardware_sim.joint_records import record as make
from stimrig.identify import muscles
from stimrig.identify.experiments.knowledge import Target
from stimrig.identify.muscles.adaptive import Asked, Decision, decide, fitted
from stimrig.identify.muscles.finish import finished
from stimrig.identify.muscles.joint_fit import JointFitted
from stimrig.identify.muscles.search import search
from stimrig.rig import protocols

CALIBRATED = 1.1
"""The largest torque that a calibration may have shown, over the true one."""
Job = tuple[int, float, float, bool]
"""Seed, noise, N·m, target, %, and whether both records are fitted alone."""


def dose_nm_s(made: dict[str, Any]) -> np.ndarray:
    """True torque-time of each muscle."""
    return np.abs(made["muscle_nm"]).sum(axis=0) / (made["time_s"].size / made["time_s"][-1])


def played(joint: Any, asked: Asked, noise_nm: float) -> tuple[np.ndarray, dict[str, Any], Decision, list[float]]:
    """Widths of a whole adaptive test, what was measured, its end, and processor seconds of each decision."""
    widths_us, made, took_s = np.zeros((0, 2)), None, []
    while True:
        begun_s = time.process_time()
        decision = decide(None if made is None else as_record(made), widths_us, asked)
        took_s.append(time.process_time() - begun_s)
        if decision.piece is None:
            assert made is not None
            return widths_us, made, decision, took_s
        widths_us = np.concatenate([widths_us, decision.piece.pulse_width_us])
        made = make(joint, *widths_us.T, noise_sd_nm=noise_nm, seed=1)


def allowed(joint: Any, fixed_us: np.ndarray, names: Sequence[str], made: dict[str, Any], target: float) -> Asked:
    """What the fixed test costs is what the adaptive one may cost."""
    tops = [float(muscle.base.largest_width_us) for muscle in (joint.agonist, joint.antagonist)]
    most = [float(one["largest_torque_nm"]) * CALIBRATED for one in joint.truth["muscles"]]
    most_s = sum(name != "validate" for name in names) / PULSES_HZ
    dose, charge = (tuple(float(value) for value in values) for values in (dose_nm_s(made), fixed_us.sum(axis=1)))
    return Asked(NAMES, Target(target, target), most_s, dose, charge, tuple(tops), tuple(most), PULSES_HZ)


def run_job(job: Job) -> dict[str, Any]:
    """One joint, tested both ways."""
    seed, noise_nm, target, plain = job
    joint = draw_joint(seed)
    tops = [float(muscle.base.largest_width_us) for muscle in (joint.agonist, joint.antagonist)]
    fixed_us, names = widths(protocols.several(NAMES), tops)
    fixed = make(joint, *fixed_us, noise_sd_nm=noise_nm, seed=1)
    asked = allowed(joint, fixed_us, names, fixed, target)
    own_us, made, decision, took_s = played(joint, asked, noise_nm)
    unseen = make(joint, *unseen_widths(seed, tops), noise_sd_nm=0.0, seed=2)
    errors, added = [], []
    for record in (as_record(made), as_record(fixed, names)):
        found, keys = _modelled(record, plain)
        errors.append(rms(muscles.predict(finished(found), as_record(unseen)) - unseen["clean_nm"]))
        added.append(keys)
    return {
        "seed": seed,
        "noise": noise_nm,
        "truth": joint.truth,
        "end": decision.kind,
        "bands": [(one.curve.percent, one.step.percent) for one in decision.knowledge],
        "seconds": len(own_us) / PULSES_HZ,
        "fixed_seconds": fixed_us.shape[1] / PULSES_HZ,
        "dose": (dose_nm_s(made) / dose_nm_s(fixed)).tolist(),
        "charge": (own_us.sum(axis=0) / fixed_us.sum(axis=1)).tolist(),
        "of_told": (dose_nm_s(made) / np.array(decision.dose_nm_s)).tolist(),
        "error": errors[0],
        "fixed_error": errors[1],
        "added": added,
        "took_s": took_s,
    }


def _modelled(record: muscles.JointRecord, plain: bool) -> tuple[JointFitted, list[str]]:
    if plain:
        found = fitted(record)
        return found, [one.key(NAMES) for one in found.acting]
    searched = search(record)
    return searched.last, [one.key for one in searched.added]


def summary(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """What was reached."""
    error, fixed, noise = (np.array([row[key] for row in rows]) for key in ("error", "fixed_error", "noise"))
    seconds, fixed_s = (np.array([row[key] for row in rows]) for key in ("seconds", "fixed_seconds"))
    dose, charge, told = (np.array([row[key] for row in rows]) for key in ("dose", "charge", "of_told"))
    took = np.concatenate([row["took_s"] for row in rows])
    return [
        ["ended as enough", f"{sum(row['end'] == 'enough' for row in rows)} of {len(rows)}"],
        ["duration, s, median", f"{np.median(seconds):.1f}, of {np.median(fixed_s):.1f}"],
        ["torque-time of a muscle over the fixed test's, median", f"{np.median(dose):.2f}; at most {dose.max():.2f}"],
        ["charge of a channel over the fixed test's, median", f"{np.median(charge):.2f}; at most {charge.max():.2f}"],
        ["true torque-time over what was told, at most", f"{told.max():.2f}"],
        ["unseen error, N·m, median", f"{np.median(error):.3f}, of {np.median(fixed):.3f}"],
        ["unseen error over the fixed test's, median", f"{np.median(error / fixed):.2f}"],
        ["the same, worse than 1.05", f"{np.mean(error > 1.05 * fixed):.0%}"],
        [
            "unseen error within 1.3 of the noise",
            f"{np.mean(error <= 1.3 * noise):.0%}, of {np.mean(fixed <= 1.3 * noise):.0%}",
        ],
        ["processor time of a decision, s", f"{np.median(took):.2f}; at most {took.max():.2f}"],
    ]


def main() -> None:
    options = parser(__doc__, "1200:1212")
    options.add_argument("--noise", type=float, default=0.05)
    options.add_argument("--target", type=float, default=2.0, help="largest half-width of the bands, %%")
    options.add_argument("--plain", action="store_true", help="no search: the fit that decides, of both records")
    options.add_argument("--workers", type=int, default=2)
    given = options.parse_args()
    jobs = [(seed, given.noise, given.target, given.plain) for seed in given.seeds]
    rows = []
    for row in in_processes(run_job, jobs, given.workers):
        rows.append(row)
        figures = {key: np.round(row[key], 2).tolist() for key in ("dose", "charge", "of_told", "bands")}
        told = f"{row['seed']} {row['end']} {row['seconds']:.1f} s error {row['error']:.4f} of {row['fixed_error']:.4f}"
        print(f"{told} {figures} added {row['added']}", flush=True)
    keep(given.json, rows)
    print("\n".join(table(("what", "reached"), summary(rows))))


if __name__ == "__main__":
    main()
