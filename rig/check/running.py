"""The whole check: its steps in their order, and the report of them."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from stimrig.rig.check import steps
from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Finding, not_done
from stimrig.rig.clock import utc_text
from stimrig.rig.config import RigConfig
from stimrig.rig.control.checked import CHECK_FILE, fingerprint
from stimrig.rig.control.memory import LatchFile
from stimrig.rig.errors import ConfigError, RigError

FORMAT, FORMAT_VERSION = "stimrig-rig-check", 1
DAY_S = 86_400.0
log = logging.getLogger("rig.check")


async def run(
    bench: Bench, days: float, about: Mapping[str, Any], tell: Callable[[str, Finding], None] = lambda *_: None
) -> dict[str, Any]:
    """Do every step, close the rig, and keep the report in the data folder.

    `days`: after so many the check is due again. `about`: what else the report says, of the rig file. `tell`: called
    after each step. Raises ConfigError: nobody says who checks; the rig waits for a person since it died in a test.
    """
    remembered, _ = await LatchFile(bench.given.data_dir, bench.ears.as_machine()).read()
    if remembered == "running":
        raise ConfigError(f"{bench.given.data_dir}: the rig died in a test; start it, look, re-arm it, then check it")
    try:
        bench.by = await bench.answer("by")
    except NotDone:
        raise ConfigError("--by: say who does this check") from None
    found = dict[str, Finding]()
    try:
        for name, step in steps.library().items():
            found[name] = await _done(step, bench)
            tell(step.TITLE, found[name])
    finally:
        if bench.rig.status().state != "disconnected":
            await bench.rig.close()
    report = {**await _report(bench, found, days), **about}
    try:
        path = bench.given.data_dir / CHECK_FILE
        data = (json.dumps(report, ensure_ascii=False, indent=1) + "\n").encode()
        await bench.tasks.work(bench.ears.as_machine().disk.replace, path, data)
    except OSError as error:
        log.error("%s: not kept: %s", bench.given.data_dir / CHECK_FILE, error.strerror)
    return report


async def _done(step: steps.Step, bench: Bench) -> Finding:
    try:
        return await step.look(bench)
    except NotDone as error:
        return not_done(str(error))
    except RigError as error:
        bench.halted = bench.halted or str(error)
        return not_done(str(error))


async def _report(bench: Bench, found: dict[str, Finding], days: float) -> dict[str, Any]:
    now_s, status = bench.clock.unix_s(), bench.rig.status()
    rows = [_row(name, finding) for name, finding in found.items()]
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "verdict": verdict(rows, bench),
        "checked_at_utc": utc_text(now_s),
        "due_at_utc": utc_text(now_s + days * DAY_S),
        "by": bench.by,
        "rig": fingerprint(bench.given),
        "software": software(),
        "emulated": bench.emulated,
        "dummy_load_ohm": bench.ohm,
        "devices": {
            "stimulator": await _identified(bench, "stimulator", status.stimulator),
            "load_cell": await _identified(bench, "load_cell", status.load_cell),
        },
        "steps": rows,
    }


def _row(name: str, finding: Finding) -> dict[str, Any]:
    step = steps.library()[name]
    fault = step.FAULTS.get(finding.fault)
    return {
        "name": name,
        "title": step.TITLE,
        "outcome": finding.outcome,
        "figure": finding.figure,
        "bound": finding.bound,
        "fault": finding.fault,
        "cause": fault.cause if fault else "",
        "mend": fault.mend if fault else "",
    }


def verdict(rows: list[dict[str, Any]], bench: Bench) -> str:
    """`faults`: a step failed; `incomplete`: one was not done that this rig needs; else `sound`."""
    if any(row["outcome"] == "failed" for row in rows):
        return "faults"
    lacks = {"angle": bench.given.angle_sensor is None, "channels": len(bench.outputs) < 2}
    lacks["sync"] = not bench.cell.get("sync")
    missing = [row for row in rows if row["outcome"] == "not done" and not lacks.get(row["name"])]
    return "incomplete" if any(steps.library()[row["name"]].NEEDED for row in missing) else "sound"


async def _identified(bench: Bench, kind: str, said: dict[str, Any]) -> dict[str, Any]:
    """What the device says of itself; its serial number is asked for where it tells none."""
    found = {name: str(said[name]) for name in ("device", "firmware", "port", "bus") if said.get(name)}
    serial = str(said.get("id") or "")
    if not serial and found:
        try:
            serial = await bench.answer(f"serial_{kind}")
        except NotDone:
            serial = ""
    return {**found, "serial_number": serial}


def software() -> str:
    try:
        return f"stimrig {version('stimrig')}"
    except PackageNotFoundError:
        return "stimrig, not installed"


def file_sha256(content: bytes) -> str:
    """Of a rig file."""
    return hashlib.sha256(content).hexdigest()


def emulated_outputs(line: dict[str, Any], config: RigConfig) -> dict[str, tuple[int, int]]:
    """Where the emulator's loads truly are, by the rig's channels."""
    places = [(int(connector), int(channel)) for connector, channel in line.get("outputs") or [[0, 0]]]
    names = [channel.name for channel in config.channels()] or [""]
    return dict(zip(names, places, strict=False))
