"""A hidden patient whose joint moves: a test over serial line and CAN with an angle sensor, sealed and diagnosed.

Beside it the same patient's record as a CSV file, by the emulator's own design.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.hidden_played import agrees, reveal
from stimrig.hardware_sim.hidden_records import patient_record, write_csv
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.records import read
from stimrig.identify.records.record import Record
from tests.harness.processes import Bench, default_plan

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


def sealed(seed: int, speed: float, folder: Path) -> dict[str, Any]:
    """The rig's word on a test of this patient: where its sealed recording is, and how punctual it was."""
    bench = Bench(folder, "--hidden", str(seed), *DESIGN, "--noise-seed", str(seed), speed=speed)
    try:
        client = bench.start_rig()
        client.ask("subscribe")
        reply = client.start(default_plan("moving", segments=SEGMENTS))
        if not reply["ok"]:
            raise RuntimeError(f"the rig refused the test: {reply}")
        return client.wait_finished("moving", LONGEST_S)
    finally:
        bench.close()


def named(record: Record, truth: dict[str, Any]) -> dict[str, Any]:
    """What the diagnosis says of a record, and whether that is what was hidden."""
    result = diagnose(record).to_dict()
    missing = [entry["effect"] for entry in result["missing"]]
    found = {"verdict": result["verdict"], "named": missing}
    first = missing[: len(truth["effects"])] == truth["effects"]
    return {**found, "named_first": first, "agrees": agrees(found, truth)}


def run(seed: int, speed: float, folder: Path) -> dict[str, Any]:
    """One seed on the wire and as a CSV file."""
    event = sealed(seed, speed, folder)
    wire = read(Path(event["recording_path"]))
    if wire.angle_rad is None:
        raise RuntimeError("the sealed recording was read without an angle")
    write_csv(patient_record(seed, moving=True), folder / "same.csv")
    truth = reveal(seed, *DESIGN)
    return {
        "seed": seed,
        "hidden": truth["effects"],
        "strength": truth["strength"],
        "wire": named(wire, truth),
        "csv": named(read(folder / "same.csv"), truth),
        "lateness_ms": event["summary"]["lateness_ms"],
        "dropped_pulses": event["summary"]["dropped_pulses"],
    }
