"""`python -m stimrig.hardware_sim`: the process behind `stimrig emulate`."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from typing import Any

from stimrig.hardware_sim import hidden
from stimrig.hardware_sim import options as command_line
from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.emulator import Emulator
from stimrig.hardware_sim.errors import HardwareSimError
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
        _run(make_devices(settings, options.arm, options.arm_law, epoch_us=time.time_ns() // 1000), options)
    except HardwareSimError as error:
        print(f"{PROG}: {error}", file=sys.stderr)
        return 2
    return 0


def _run(devices: Devices, options: argparse.Namespace) -> None:
    emulator = Emulator(devices)
    signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda caught, _frame: signals.append(caught))
    # before the ready line, since a parent may die as soon as it has read it; the kernel is asked each time, since a
    # death signal would depend on the thread that started this process
    parent = os.getppid() if options.die_with_parent else None
    try:
        for text in options.fault:
            devices.faults.on(*_fault(text))
        print(json.dumps(emulator.ready()), flush=True)
        if options.speed <= FASTEST_AT_PRIORITY:
            with contextlib.suppress(OSError):  # where allowed: a real device does not slow down under the host's load
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        emulator.run(lambda: bool(signals) or (parent is not None and os.getppid() != parent))
    finally:
        emulator.close()


def _fault(text: str) -> tuple[str, dict[str, Any]]:
    name, *pairs = text.split(",")
    settings: dict[str, Any] = {}
    for pair in pairs:
        key, _, value = pair.partition("=")
        try:
            settings[key] = {"true": True, "false": False}[value] if value in ("true", "false") else float(value)
        except ValueError:
            raise HardwareSimError(f"--fault {text}: '{pair}' must be SETTING=NUMBER") from None
    return name, settings


if __name__ == "__main__":
    sys.exit(main())
