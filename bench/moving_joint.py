"""f, G, g and h of simulated arms from joined records, beside the truth; see docs/moving-joint.md.

    python -m bench.moving_joint --arms 1000:1050 [--json FILE]

The arms come from `bench.muscles.arm_patient`, whose laws and distributions were written apart from the library. Arms
0 to 99 were developed on; report on arms from 1000. Of each arm: the paper's isometric test, and the three guided tests
(passive; held at four angles; moving), with torque-times of each; then an unseen trial with another movement.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

from bench.common import bench_parser, in_processes, write_json, written_by
from bench.muscles.arm_patient import ArmPatient, arm_patient
from bench.muscles.arm_records import record
from stimrig.api.sessions import joint_plan
from stimrig.identify.fitting import MOVING_JOINT, fit
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import predict
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import as_record

PASSIVE_S, UNSEEN_S, RATE_HZ = 66.0, 30.0, 40.0


def torque_time_nms(arm: ArmPatient, simulated: dict[str, Any]) -> float:
    """Integrate the active torque over time, N·m·s."""
    truth = simulated["truth"]
    active = arm.g(truth["angle_rad"], truth["velocity_rad_s"]) * truth["isometric_nm"]
    return float(np.sum(np.abs(active)) * (simulated["time_s"][1] - simulated["time_s"][0]))


def identify_arm(seed: int) -> dict[str, Any]:
    """Identify one arm and return the errors against its truth."""
    arm = arm_patient(seed)
    isometric = record(arm, "isometric", seed)
    alone = fit(as_record(isometric))
    guided = guided_tests(arm, alone, isometric, seed)
    unseen = record(arm, "unseen", seed, duration_s=UNSEEN_S)
    dose = {"paper": torque_time_nms(arm, isometric), "guided": sum(torque_time_nms(arm, each) for each in guided)}
    row = {"seed": seed, "laws": laws(arm), "dose": dose}
    row["isometric"] = active_errors(arm, alone, arm.reference_rad)
    for name, records in (("guided", guided), ("all", [isometric, *guided])):
        began = time.process_time()
        model = fit(joined(records), effects=MOVING_JOINT)
        row[name] = {"cpu_s": time.process_time() - began, **judged(arm, Model.from_json(model.to_json()), unseen)}
    return row


def guided_tests(arm: ArmPatient, model: Model, isometric: dict[str, Any], seed: int) -> list[dict[str, Any]]:
    """The three tests as the service plans them with the model of the isometric test: passive, held, moving."""
    width_us, torque_nm = model.recruitment.table()
    top_us = float(arm.largest_width_us)
    curve = joint_plan.curve_of({"pulse_width_us": list(width_us), "torque_nm": list(torque_nm)}, top_us, None)
    every = round(isometric["time_s"].size / (isometric["time_s"][-1] * RATE_HZ))
    layout = joint_plan.layout(arm.range_rad, curve, top_us, isometric["pulse_width_us"][::every], RATE_HZ)
    records = [record(arm, "passive", seed, duration_s=PASSIVE_S)]
    for place, x in enumerate(layout.targets_rad):
        held_record = record(arm, "held", 10 * seed + place, angle_rad=x, parts=parts_of(layout.held))
        records.append(held_record)
    return [*records, record(arm, "moving", seed, parts=parts_of(layout.moving))]


def parts_of(segments: list[dict[str, Any]]) -> list[tuple[str, np.ndarray]]:
    """Segments of a plan, as records are made of them."""
    return [(each["name"], np.array(each["settings"]["pulse_width_us"])) for each in segments]


def joined(records: list[dict[str, Any]]) -> Record:
    """The records as the parts of one, two minutes apart."""
    return join([as_record(each) for each in records], [120.0 * place for place in range(len(records))])


def laws(arm: ArmPatient) -> dict[str, Any]:
    """Return the names of the arm's laws."""
    return {place: arm.truth[place]["law"] for place in ("passive", "torque_angle", "torque_velocity")}


def judged(arm: ArmPatient, model: Model, unseen: dict[str, Any]) -> dict[str, Any]:
    """Return the errors of g and h where data were measured, the coverage of their bands, and the unseen error."""
    known = {name: np.asarray(value) for name, value in model.joint.items() if name != "formula"}
    reference = float(known["reference_angle_rad"])
    x, v = np.meshgrid(known["angle_rad"], known["velocity_rad_s"], indexing="ij")
    truth = {"h": arm.h_nm(x, v) - arm.h_nm(reference, 0.0), "g": arm.g(x, v) / arm.g(reference, 0.0)}
    figures: dict[str, Any] = {"reference_rad": reference}
    for name, unit in (("h", "_nm"), ("g", "")):
        visited = known[f"seen_{name}"] > 0
        error = (known[f"{name}{unit}"] - truth[name])[visited]
        scale = float(np.ptp(truth[name][visited])) if name == "h" else 1.0
        inside = (truth[name] >= known[f"{name}_lower{unit}"]) & (truth[name] <= known[f"{name}_upper{unit}"])
        figures[name] = {
            "rms": float(np.sqrt(np.mean(error**2))) / scale,
            "p95": float(np.percentile(np.abs(error), 95)) / scale,
            "covered": float(np.mean(inside[visited])),
        }
    error_nm = unseen["torque_nm"] - predict(model, as_record(unseen))
    # The sensor's zero of another day is not the model's.
    error_nm = error_nm - np.median(error_nm)
    noise_sd_nm = unseen["truth"]["noise_sd_nm"]
    figures["unseen_over_noise"] = float(np.sqrt(np.mean(error_nm**2))) / noise_sd_nm
    stimulated_rad = known["angle_rad"][np.any(known["seen_g"] > 0, axis=1)]
    angle_rad = unseen["truth"]["angle_rad"]
    inside = (angle_rad >= stimulated_rad.min()) & (angle_rad <= stimulated_rad.max())
    figures["unseen_outside"] = float(np.mean(~inside))
    figures["unseen_inside_over_noise"] = float(np.sqrt(np.mean(error_nm[inside] ** 2))) / noise_sd_nm
    return figures | active_errors(arm, model, reference)


def active_errors(arm: ArmPatient, model: Model, reference_rad: float) -> dict[str, float]:
    """Errors of f, as a share of its largest value, and of G's step response, root mean square."""
    width_us = np.linspace(0.0, float(model.valid_for["pulse_width_us"][1]), 201)
    f_nm = arm.recruitment_nm(width_us) * float(arm.g(reference_rad, 0.0))
    time_s = np.linspace(0.0, 2.0, 401)
    fine = np.full(401, float(arm.largest_width_us))
    step = arm.isometric_nm(fine, time_s[1]) / float(arm.recruitment_nm(float(arm.largest_width_us)))
    return {
        "f": float(np.sqrt(np.mean((model.recruitment(width_us) - f_nm) ** 2)) / np.ptp(f_nm)),
        "G": float(np.sqrt(np.mean((model.linear.step_response(time_s) - step) ** 2))),
    }


def print_goals(rows: list[dict[str, Any]]) -> None:
    """Print each goal beside the measured figure."""
    for name in ("guided", "all"):
        print(f"{'three guided tests' if name == 'guided' else 'and the isometric test'}, {len(rows)} arms")
        for part, goal in (("h", 0.05), ("g", 0.07)):
            errors = np.array([row[name][part]["rms"] for row in rows])
            p95 = np.array([row[name][part]["p95"] for row in rows])
            covered = np.mean([row[name][part]["covered"] for row in rows])
            print(
                f"  {part}: rms within {100 * goal:g} %: {np.sum(errors <= goal)} of {errors.size}, median "
                f"{100 * np.median(errors):.2f} %, worst {100 * errors.max():.2f} %; 95 % of the cells within it: "
                f"{np.sum(p95 <= goal)}; bands hold {100 * covered:.1f} %"
            )
        for part in ("f", "G"):
            ours, alone = (np.array([row[key][part] for row in rows]) for key in (name, "isometric"))
            print(
                f"  {part}: median error {100 * np.median(ours):.2f} %, isometric alone {100 * np.median(alone):.2f} %;"
                f" no worse in {np.sum(ours <= 1.05 * alone)} of {ours.size}"
            )
        for key, where in (("", ""), ("inside_", ", at angles that were stimulated")):
            unseen = np.array([row[name][f"unseen_{key}over_noise"] for row in rows])
            print(
                f"  unseen movement{where}: error {np.median(unseen):.2f} x noise (median), within 1.3: "
                f"{np.sum(unseen <= 1.3)} of {unseen.size}, worst {unseen.max():.2f}"
            )
        outside, cpu_s = (np.median([row[name][key] for row in rows]) for key in ("unseen_outside", "cpu_s"))
        print(f"  {100 * outside:.0f} % of the unseen movement elsewhere (median); fit {cpu_s:.1f} s of a processor")
    share = np.array([row["dose"]["guided"] / row["dose"]["paper"] for row in rows])
    print(f"torque-time of the three over the paper's test: median {np.median(share):.2f}, largest {share.max():.2f}")


def main() -> None:
    """Run."""
    parser = bench_parser(__doc__, "1000:1050", "--arms")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    rows = []
    for row in in_processes(identify_arm, options.arms, options.workers):
        rows.append(row)
        errors = [row["all"]["h"]["rms"], row["all"]["g"]["rms"]]
        errors_text = f"{errors[0]:.3f} {errors[1]:.3f} {row['all']['unseen_over_noise']:.2f}"
        print(f"arm {row['seed']}: {row['laws']} {errors_text}", file=sys.stderr, flush=True)
    print(written_by(f"python -m bench.moving_joint --arms {options.arms.start}:{options.arms.stop}"))
    print_goals(rows)
    write_json(options.json, rows)


if __name__ == "__main__":
    main()
