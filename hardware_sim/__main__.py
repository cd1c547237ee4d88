"""`python -m stimrig.hardware_sim`: the process behind `stimrig emulate`."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from stimrig.hardware_sim import hidden
from stimrig.hardware_sim import options as command_line
from stimrig.hardware_sim.emulator import Emulator
from stimrig.hardware_sim.errors import FaultError, HardwareSimError
from stimrig.hardware_sim.factory import HIDDEN, make_devices

PROG = "stimrig emulate"
FASTEST_AT_PRIORITY = 5.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the emulator; the exit code: 0 done, 2 bad input."""
    try:
        options = command_line.parse(arguments, PROG)
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else 2
    try:
        if options.reveal is not None:
            print(json.dumps(hidden.reveal(options.reveal, moving=options.arm is not None)))
            return 0
        patient = options.patient if options.hidden is None else f"{HIDDEN}{options.hidden}"
        settings = command_line.settings(options, patient)
        emulator = Emulator(make_devices(settings, options.arm, options.arm_law, epoch_us=time.time_ns() // 1000))
    except HardwareSimError as error:
        print(f"{PROG}: {error}", file=sys.stderr)
        return 2
    try:
        for text in options.fault:
            emulator.devices.faults.on(*_fault(text))
        return _run(emulator, options)
    except FaultError as error:
        print(f"{PROG}: {error}", file=sys.stderr)
        return 2
    finally:
        emulator.close()


def _run(emulator: Emulator, options: argparse.Namespace) -> int:
    signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda caught, _frame: signals.append(caught))
    # before the ready line, since a parent may die as soon as it has read it
    orphaned = _orphan_watch() if options.die_with_parent else lambda: False
    ready = emulator.ready()
    if options.no_json:
        print(*(f"{key}: {value}" for key, value in ready.items()), sep="\n", flush=True)
    else:
        print(json.dumps(ready), flush=True)
    if options.speed <= FASTEST_AT_PRIORITY:
        _take_priority()
    emulator.run(lambda: bool(signals) or orphaned())
    return 0


def _take_priority() -> None:
    """Real-time priority if the system allows it: a real device does not slow down under the host's load."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def _orphan_watch() -> Callable[[], bool]:
    """A function that says whether the parent has ended.

    It asks the kernel each time. A death signal would depend on the thread that started this process.
    """
    parent = os.getppid()
    return lambda: os.getppid() != parent


def _fault(text: str) -> tuple[str, dict[str, Any]]:
    name, *pairs = text.split(",")
    settings: dict[str, Any] = {}
    for pair in pairs:
        key, _, value = pair.partition("=")
        try:
            settings[key] = {"true": True, "false": False}[value] if value in ("true", "false") else float(value)
        except ValueError:
            raise FaultError(f"--fault {text}: '{pair}' must be SETTING=NUMBER") from None
    return name, settings


if __name__ == "__main__":
    sys.exit(main())
