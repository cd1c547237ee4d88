"""`python -m stimrig.hardware_sim`: the process behind `stimrig emulate`, and its command line."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import secrets
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NoReturn

from stimrig.hardware_sim import hidden
from stimrig.hardware_sim.arm.movers import MOVERS
from stimrig.hardware_sim.arm.tissue import DEFAULT_LAWS, PLACES
from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.emulator import Emulator
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.factory import HIDDEN, make_devices
from stimrig.hardware_sim.load_cells import CELLS, TRANSPORTS
from stimrig.hardware_sim.load_cells.cells import WithAngle
from stimrig.hardware_sim.patients import PATIENTS
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators import STIMULATORS

PROG = "stimrig emulate"
FASTEST_AT_PRIORITY = 5.0
DEFAULTS = Settings()


class OneLineParser(argparse.ArgumentParser):
    """Bad input costs one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        """One line on standard error."""
        print(f"{self.prog}: {message} (see --help)", file=sys.stderr)
        raise SystemExit(2)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options as given; bad input ends with one line and exit code 2."""
    parser = OneLineParser(
        prog=PROG,
        description="The emulated rig: a stimulator on a serial line, a CAN load cell, and a muscle between "
        "them. Prints one JSON line once its devices answer, then runs until SIGTERM or Ctrl-C.",
    )
    muscle = parser.add_argument_group("the muscle").add_mutually_exclusive_group()
    muscle.add_argument(
        "--patient",
        default=DEFAULTS.patient,
        metavar="NAME|FILE",
        help=f"{', '.join(PATIENTS)}, or a TOML file with 'patient' and a table 'parameters' (default: %(default)s)",
    )
    muscle.add_argument(
        "--hidden",
        type=int,
        metavar="SEED",
        help="a patient with a hidden effect, drawn by SEED; with --arm another one, whose joint matters",
    )
    muscle.add_argument("--reveal", type=int, metavar="SEED", help="print what --hidden SEED hides, and exit")
    devices = parser.add_argument_group("the devices")
    devices.add_argument("--stimulator", default=DEFAULTS.stimulator, choices=STIMULATORS)
    devices.add_argument(
        "--load-cell",
        dest="transport",
        default=DEFAULTS.transport,
        choices=TRANSPORTS,
        help="what carries the cell's frames: a server on 127.0.0.1, or an adapter on a pseudo-terminal "
        "(default: %(default)s)",
    )
    devices.add_argument(
        "--cell",
        choices=CELLS,
        help=f"the cell's frames (default: {DEFAULTS.cell}: id 0x181, float32 N·m, counter, status)",
    )
    devices.add_argument("--no-sync", action="store_true", help="no sync line from the stimulator to the cell")
    devices.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[,SETTING=NUMBER…]",
        help="switch a fault on from the start; may be repeated",
    )
    arm = parser.add_argument_group("the arm and the sensor of its angle (only with --arm)")
    arm.add_argument(
        "--arm",
        metavar="MODE[,SETTING=NUMBER…]",
        help=f"what holds or moves the elbow: {', '.join(MOVERS)}; with --hidden also "
        "'design', the movement that its effect was sized on (default: no arm, the joint is still and has no sensor)",
    )
    arm.add_argument(
        "--arm-law",
        action="append",
        default=[],
        metavar="PLACE=NAME[,PARAMETER=NUMBER…]",
        help=f"another law of its tissue, or other numbers, at {', '.join(PLACES)}; may be repeated (default: "
        f"{', '.join(f'{place}={name}' for place, name in DEFAULT_LAWS.items())}; 'none' for no law)",
    )
    process = parser.add_argument_group("the process")
    for each in fields(Settings):
        if "option" in each.metadata:
            group = process if each.name == "speed" else arm if each.name.startswith("angle") else devices
            group.add_argument("--" + each.name.replace("_", "-"), **each.metadata["option"])
    process.add_argument("--die-with-parent", action="store_true", help="end when the process that started it does")
    return parser.parse_args(arguments)


def checked_settings(options: argparse.Namespace, patient: str) -> Settings:
    """The checked settings of these options. Raises HardwareSimError: a number is out of its range.

    The cell with an angle is there where, and only where, the angle is in its frame.
    """
    values = {field.name: getattr(options, field.name) for field in fields(Settings) if hasattr(options, field.name)}
    if options.noise_seed is None:
        values["noise_seed"] = secrets.randbelow(2**31)
    in_cell = options.arm is not None and options.angle == "in-cell"
    cell = options.cell or (WithAngle.name if in_cell else DEFAULTS.cell)
    if in_cell != (cell == WithAngle.name):
        raise HardwareSimError(f"--cell {WithAngle.name} goes with --arm and --angle in-cell, and no other cell does")
    return Settings(**values | {"patient": patient, "cell": cell, "sync": not options.no_sync})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the emulator; the exit code: 0 done, 2 bad input."""
    try:
        options = parse(arguments)
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else 2
    try:
        if options.reveal is not None:
            print(json.dumps(hidden.reveal(options.reveal, moving=options.arm is not None)))
            return 0
        patient = options.patient if options.hidden is None else f"{HIDDEN}{options.hidden}"
        settings = checked_settings(options, patient)
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
