"""Hidden patients on the wire, through REST alone: test, compare, diagnose, next experiment, add, and what was hidden.

    python -m bench.hidden_on_the_wire --seeds 1000:1008
    python -m bench.hidden_on_the_wire --moving --seeds 2520:2540

`--moving`: patients whose joint moves, with an angle sensor; one test, sealed, read and diagnosed, and beside it the
same patient's record as a CSV file, by the emulator's own design. `--hiding`: only the seeds among them that hide this
effect, asked before they are played.

Every seed counts. `--speed` lets emulator and rig run faster than real time (a busy machine makes the result noisy).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bench.common import emulated_rig, keep, parser, reveal, services
from stimrig.api.cli.errors import CommandError
from stimrig.api.client.errors import ServiceError
from stimrig.api.client.rest import Client
from stimrig.hardware_sim.hidden_records import patient_record, write_csv
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.records import read
from stimrig.identify.records.record import Record
from tests.harness.processes import default_plan

PARTICIPANT = "HIDDEN"
NOISE_LIKE = 1.3
DESIGN = ("--arm", "design")
"""The movement on which the effect was sized; the patient is another one than without an arm."""
LONGEST_S = 120.0
SEGMENTS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 2.0}},
    {"name": "prbs", "sequence": "prbs"},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 3.0}},
    {"name": "ramp", "sequence": "ramp"},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 2.0}},
    {"name": "validate", "sequence": "multilevel", "settings": {"duration_s": 16.0}},
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 2.0}},
]
"""The default test with 16 s held out, as the offline design has, by the rig's own sequences."""


def play(client: Client) -> dict[str, Any]:
    """The whole path; nothing in it knows the seed."""
    client.ensure_participant(PARTICIPANT)
    test = client.run_test(PARTICIPANT)
    model, tests = test["model_id"], [test]
    found = client.diagnosis(model)
    steps = [summary(client, model)]
    first, experiment = found, None
    if found["verdict"] == "effect_missing" and found.get("experiment"):
        experiment = found["experiment"]
        plan = {"kind": "next-experiment", "segments": experiment["segments"], "joins": model}
        tests.append(client.run_test(PARTICIPANT, **plan))
        model = tests[-1]["model_id"]
        found = client.diagnosis(model)
        steps.append(summary(client, model))
    if found["verdict"] == "effect_missing":
        for entry in found["missing"]:
            model = client.add_effects(model, [entry["effect"]])["id"]
            steps.append(summary(client, model))
    return {
        "verdict": found["verdict"],
        "named": [entry["effect"] for entry in found["missing"]],
        "confused_with": [rival for entry in found["missing"] for rival in entry["confused_with"]],
        "verdict_before_experiment": first["verdict"],
        "named_before_experiment": [entry["effect"] for entry in first["missing"]],
        "experiment": experiment and experiment["text"],
        "steps": steps,
        **punctuality([each["summary"] for each in tests]),
    }


def punctuality(summaries: list[dict[str, Any]]) -> dict[str, Any]:
    """How late pulses were in the worst of the tests, and how many were dropped in all."""
    late = [each["lateness_ms"] for each in summaries]
    return {
        "lateness_ms": {key: max(each[key] for each in late) for key in ("median", "p99", "max")},
        "dropped_pulses": sum(each["dropped_pulses"] for each in summaries),
    }


def summary(client: Client, model_id: str) -> dict[str, Any]:
    """A version's errors."""
    version, comparison = client.version(model_id), client.comparison(model_id)
    held = comparison.get("held_out") or comparison
    return {
        "effects": version["effects"],
        "held_out_rms_nm": held["rms_nm"],
        "noise_sd_nm": comparison["noise_sd_nm"],
        "times_noise": held["rms_nm"] / comparison["noise_sd_nm"],
    }


def agrees(found: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether the verdict is what was hidden: one effect named first, two both named; nothing; or no name for it."""
    if truth["outside_library"]:
        return found["verdict"] == "unexplained_structure"
    if not truth["effects"]:
        return found["verdict"] == "nothing_missing"
    first = found["named"][: len(truth["effects"])]
    return found["verdict"] == "effect_missing" and set(truth["effects"]) == set(first)


def still(seed: int, speed: float) -> dict[str, Any]:
    """One seed on services of its own."""
    with services("--hidden", str(seed), "--speed", str(speed), "--noise-seed", str(seed)) as (_, client):
        found = play(client)
    truth = reveal(seed)
    last = found["steps"][-1]["times_noise"]
    return {
        "seed": seed,
        "hidden": truth["effects"],
        "strength": truth["strength"],
        "outside_library": truth["outside_library"],
        **found,
        "agrees": agrees(found, truth),
        "noise_like": last <= NOISE_LIKE,
        "times_noise": [round(step["times_noise"], 2) for step in found["steps"]],
    }


def sealed(seed: int, speed: float) -> tuple[dict[str, Any], Record]:
    """The rig's word on a test of this patient, how punctual it was, and its sealed recording."""
    emulator = ("--hidden", str(seed), *DESIGN, "--noise-seed", str(seed))
    with emulated_rig(*emulator, speed=speed) as (_, client):
        reply = client.start(default_plan("moving", segments=SEGMENTS))
        if not reply["ok"]:
            raise RuntimeError(f"the rig refused the test: {reply}")
        event = client.wait_finished("moving", LONGEST_S)
        return event, read(Path(event["recording_path"]))


def named(record: Record, truth: dict[str, Any]) -> dict[str, Any]:
    """What the diagnosis says of a record, and whether that is what was hidden."""
    result = diagnose(record).to_dict()
    missing = [entry["effect"] for entry in result["missing"]]
    found = {"verdict": result["verdict"], "named": missing}
    first = missing[: len(truth["effects"])] == truth["effects"]
    return {**found, "named_first": first, "agrees": agrees(found, truth)}


def moving(seed: int, speed: float) -> dict[str, Any]:
    """One seed on the wire and as a CSV file."""
    event, record = sealed(seed, speed)
    if record.angle_rad is None:
        raise RuntimeError("the sealed recording was read without an angle")
    truth = reveal(seed, *DESIGN)
    with tempfile.TemporaryDirectory(prefix="moving-") as folder:
        path = Path(folder) / "same.csv"
        write_csv(patient_record(seed, moving=True), path)
        same = named(read(path), truth)
    return {
        "seed": seed,
        "hidden": truth["effects"],
        "strength": truth["strength"],
        "wire": named(record, truth),
        "csv": same,
        "lateness_ms": event["summary"]["lateness_ms"],
        "dropped_pulses": event["summary"]["dropped_pulses"],
    }


def main() -> None:
    """Print one line a seed, and how many agree."""
    made = parser(__doc__, "1000:1008")
    made.add_argument("--speed", type=float, default=2.0)
    made.add_argument("--moving", action="store_true", help="patients whose joint moves")
    made.add_argument("--hiding", help="with --moving: only seeds that hide this effect")
    options = made.parse_args()
    seeds = [s for s in options.seeds if not options.hiding or options.hiding in reveal(s, *DESIGN)["effects"]]
    keep(options.json, (_moving if options.moving else _still)(seeds, options.speed))


def _still(seeds: Iterable[int], speed: float) -> list[dict[str, Any]]:
    rows = []
    for seed in seeds:
        try:
            row = still(seed, speed)
        except (CommandError, ServiceError) as error:
            rows.append({"seed": seed, "agrees": False, "error": str(error)})
            print(f"{seed}  FAILED: {error}", flush=True)
            continue
        rows.append(row)
        hidden = "+".join(row["hidden"]) or "nothing"
        print(
            f"{seed}  hidden {hidden} ({row['strength']}{', outside' if row['outside_library'] else ''})  "
            f"verdict {row['verdict']}: {', '.join(row['named']) or '-'}  before the experiment "
            f"{', '.join(row['named_before_experiment']) or '-'}  error/noise {row['times_noise']}  "
            f"pulses late {row['lateness_ms']} ms, {row['dropped_pulses']} dropped  "
            f"{'agrees' if row['agrees'] else 'DIFFERS'}",
            flush=True,
        )
    print(f"{sum(row['agrees'] for row in rows)} of {len(rows)} agree")
    return rows


def _moving(seeds: Iterable[int], speed: float) -> list[dict[str, Any]]:
    """Rows, printed as they come, and the totals of each effect on the wire and as a file."""
    rows = []
    for seed in seeds:
        row = moving(seed, speed)
        rows.append(row)
        told = {where: f"{row[where]['verdict']}: {', '.join(row[where]['named']) or '-'}" for where in ("wire", "csv")}
        print(
            f"{seed}  hidden {'+'.join(row['hidden']) or 'nothing'} ({row['strength']})  wire {told['wire']}  "
            f"csv {told['csv']}  pulses late {row['lateness_ms']} ms, {row['dropped_pulses']} dropped",
            flush=True,
        )
    for effect in sorted({"+".join(row["hidden"]) for row in rows}):
        of_it = [row for row in rows if "+".join(row["hidden"]) == effect]
        right = {where: sum(row[where]["agrees"] for row in of_it) for where in ("wire", "csv")}
        first = {where: sum(row[where]["named_first"] for row in of_it) for where in ("wire", "csv")}
        print(
            f"{effect or 'nothing'}: right {right['wire']} of {len(of_it)} on the wire, {right['csv']} as a file; "
            f"named first {first['wire']} and {first['csv']}"
        )
    return rows


if __name__ == "__main__":
    main()
