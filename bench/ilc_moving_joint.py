"""The controller of `examples/ilc_moving_joint.py` on simulated arms, with g and h and without.

    python -m bench.ilc_moving_joint --arms 1100:1108 [--trials 8] [--json FILE]

Each arm is identified as in `bench.moving_joint`. Then a robot repeats a movement in every trial, never quite alike: it
begins up to 80 ms early or late, is 3 % faster or slower, and 2 degrees beside. Both models learn by the same law. Arms
0 to 99 were developed on.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from bench.common import ROOT, bench_parser, in_processes, write_json, written_by
from bench.moving_joint import MOVING_JOINT, as_record, guided_tests, joined
from bench.muscles.arm_patient import ArmPatient, arm_patient
from bench.muscles.arm_records import record
from stimrig.identify.fitting import fit
from stimrig.identify.model import Model
from stimrig.identify.problem.pulses import above_rest

sys.path.insert(0, str(ROOT / "examples"))
from ilc_controller import Reference
from ilc_moving_joint import learn_moving

FINE_HZ = 1600
NOISE_NM = 0.07
LATE_S, FASTER, OFFSET_RAD = 0.08, 0.03, 0.035


class Simulated:
    """Takes the place of the service: the arm plays a trial, the model predicts it."""

    def __init__(self, arm: ArmPatient, model: Model, seed: int) -> None:
        self.arm, self.model, self.rng = arm, model, np.random.default_rng(seed)

    def movement(self, time_s: np.ndarray) -> np.ndarray:
        """Out and back twice, within the range of the day, rad."""
        low, high = self.arm.range_rad
        turn = np.clip(time_s, 0.0, 10.0) * 2 * np.pi / 5.0
        return low + (high - low) * (0.25 + 0.25 * (1 - np.cos(turn)))

    def play_moving(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One trial of the arm, with its own lateness, speed and place."""
        each = FINE_HZ // 40
        late_s, faster = self.rng.uniform(-LATE_S, LATE_S), 1 + self.rng.uniform(-FASTER, FASTER)
        offset_rad = self.rng.uniform(-OFFSET_RAD, OFFSET_RAD)
        time_s = np.arange(-FINE_HZ, widths_us.size * each) / FINE_HZ  # a second of rest before it
        angle = self.movement((time_s - late_s) * faster) + offset_rad
        velocity = np.gradient(angle, 1 / FINE_HZ)
        width = np.r_[np.zeros(FINE_HZ), np.repeat(widths_us, each)]
        arm = self.arm
        torque = arm.g(angle, velocity) * arm.isometric_nm(width, 1 / FINE_HZ)
        torque = torque + arm.h_nm(angle, velocity) + arm.remembered_nm(angle, 1 / FINE_HZ)
        torque -= arm.inertia_kg_m2 * np.gradient(velocity, 1 / FINE_HZ)
        torque += NOISE_NM * self.rng.standard_normal(torque.size)
        rest, trial = torque[: FINE_HZ - 200].mean(), torque[FINE_HZ:]
        read = np.round(angle[FINE_HZ:].reshape(-1, each).mean(axis=1) / 7.7e-4) * 7.7e-4
        return trial.reshape(-1, each).mean(axis=1) - rest, widths_us, read

    def foretell(self, model: dict[str, Any], widths_us: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
        """Predict the torque along these angles, N·m above rest."""
        return above_rest(self.model, widths_us, 40.0, angle_rad if model.get("joint") else None)


def learn_arm(job: tuple[int, int]) -> dict[str, Any]:
    """Learn with both models on one arm; return the tracking error of each trial in %."""
    seed, trials = job
    arm = arm_patient(seed)
    isometric = record(arm, "isometric", seed)
    alone = fit(as_record(isometric))
    whole = fit(joined([isometric, *guided_tests(arm, alone, isometric, seed)]), effects=MOVING_JOINT)
    shape = Reference.reach(0.45 * float(arm.recruitment_nm(arm.largest_width_us)))
    errors: dict[str, Any] = {"seed": seed}
    for name, model in (("with g and h", whole), ("without", alone)):
        service = Simulated(arm, model, seed)
        planned_rad = service.movement((np.arange(shape.torque_nm.size) + 0.5) / 40)
        # The reference is added to the passive torque of the joint, as a therapist would set it.
        passive = above_rest(whole, np.zeros(planned_rad.size), 40.0, planned_rad)
        reference = Reference(shape.torque_nm * np.clip(arm.g(planned_rad, 0.0), 0.2, 1.0) + passive)
        done = learn_moving(service, model.to_dict(), reference, planned_rad, trials)
        errors[name] = [trial.error_percent * reference.rms_nm / shape.rms_nm for trial in done]
    return errors


def main() -> None:
    """Run."""
    parser = bench_parser(__doc__, "1100:1108", "--arms")
    parser.add_argument("--trials", type=int, default=8)
    options = parser.parse_args()
    rows = list(in_processes(learn_arm, [(seed, options.trials) for seed in options.arms]))
    arms = f"{options.arms.start}:{options.arms.stop}"
    print(written_by(f"python -m bench.ilc_moving_joint --arms {arms} --trials {options.trials}"))
    print("error in % of the stimulated torque's rms, median over arms (largest)")
    print("trial  with g and h        without")
    for number in range(options.trials):
        cells = [np.array([row[name][number] for row in rows]) for name in ("with g and h", "without")]
        print(f"{number + 1:5d}  " + "  ".join(f"{np.median(cell):6.2f} ({cell.max():6.2f})" for cell in cells))
    write_json(options.json, rows)


if __name__ == "__main__":
    main()
