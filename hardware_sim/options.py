"""The command line of the emulator."""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Sequence
from dataclasses import fields
from typing import NoReturn

from stimrig.hardware_sim.arm.movers import MOVERS
from stimrig.hardware_sim.arm.tissue import DEFAULT_LAWS, PLACES
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.load_cells import CELLS, TRANSPORTS
from stimrig.hardware_sim.load_cells.cells import WithAngle
from stimrig.hardware_sim.patients import PATIENTS
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators import STIMULATORS

DEFAULTS = Settings()


class OneLineParser(argparse.ArgumentParser):
    """Bad input costs one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        """One line on standard error."""
        print(f"{self.prog}: {message} (see --help)", file=sys.stderr)
        raise SystemExit(2)


def parse(arguments: Sequence[str] | None = None, prog: str = "stimrig emulate") -> argparse.Namespace:
    """The options as given; bad input ends with one line and exit code 2."""
    parser = OneLineParser(
        prog=prog,
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


def settings(options: argparse.Namespace, patient: str) -> Settings:
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
