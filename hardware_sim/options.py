"""The command line of the emulator."""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Sequence
from dataclasses import fields
from typing import NoReturn

from stimrig.hardware_sim import stimulators
from stimrig.hardware_sim.arm.laws import LAWS
from stimrig.hardware_sim.arm.movers import MOVERS
from stimrig.hardware_sim.arm.tissue import DEFAULT_LAWS
from stimrig.hardware_sim.errors import SettingsError
from stimrig.hardware_sim.load_cells import cells, transports
from stimrig.hardware_sim.patients import registry
from stimrig.hardware_sim.scan import modules_with
from stimrig.hardware_sim.settings import ANGLES, Settings

DEFAULTS = Settings()
WITH_ANGLE = "with_angle"


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
    _who(parser.add_argument_group("the muscle"))
    devices = parser.add_argument_group("the devices")
    _devices(devices)
    _samples(devices)
    _arm(parser.add_argument_group("the arm and the sensor of its angle (only with --arm)"))
    _process(parser.add_argument_group("the process"))
    return parser.parse_args(arguments)


def settings(options: argparse.Namespace, patient: str) -> Settings:
    """The checked settings of these options.

    Raises
    ------
    SettingsError
        A number is out of its range.
    """
    given = {one.name: getattr(options, one.name) for one in fields(Settings) if hasattr(options, one.name)}
    if options.noise_seed is None:
        given["noise_seed"] = secrets.randbelow(2**31)
    given |= {"patient": patient, "cell": _cell_kind(options), "sync": not options.no_sync}
    return Settings(**given)


def _cell_kind(options: argparse.Namespace) -> str:
    """The cell as asked for; the one with an angle is there where, and only where, the angle is in its frame."""
    in_cell = options.arm is not None and options.angle == "in-cell"
    kind = options.cell or (WITH_ANGLE if in_cell else DEFAULTS.cell)
    if in_cell != (kind == WITH_ANGLE):
        raise SettingsError(f"--cell {WITH_ANGLE} goes with --arm and --angle in-cell, and no other cell does")
    return kind


def _who(group: argparse._ArgumentGroup) -> None:
    who = group.add_mutually_exclusive_group()
    who.add_argument(
        "--patient",
        default=DEFAULTS.patient,
        metavar="NAME|FILE",
        help=f"{', '.join(registry.names())}, or a TOML or JSON file with 'patient' and a table 'parameters' "
        "(default: %(default)s)",
    )
    who.add_argument(
        "--hidden",
        type=int,
        metavar="SEED",
        help="a patient with a hidden effect, drawn by SEED; with --arm another one, whose joint matters",
    )
    who.add_argument("--reveal", type=int, metavar="SEED", help="print what --hidden SEED hides, and exit")


def _devices(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--stimulator", default=DEFAULTS.stimulator, choices=modules_with(stimulators, "Firmware"))
    group.add_argument(
        "--load-cell",
        dest="transport",
        default=DEFAULTS.transport,
        choices=modules_with(transports, "Transport"),
        help="what carries the cell's frames: a server on 127.0.0.1, or an adapter on a pseudo-terminal "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--cell",
        choices=modules_with(cells, "Cell"),
        help=f"the cell's frames (default: {DEFAULTS.cell}: id 0x181, float32 N·m, counter, status)",
    )
    group.add_argument("--no-sync", action="store_true", help="no sync line from the stimulator to the cell")
    group.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[,SETTING=NUMBER…]",
        help="switch a fault on from the start; may be repeated",
    )


def _number(group: argparse._ArgumentGroup, name: str, metavar: str, what: str) -> None:
    """A number of the settings, with their default."""
    default = getattr(DEFAULTS, name.replace("-", "_"))
    text = f"{what} (default: %(default)g)"
    group.add_argument(f"--{name}", type=type(default), default=default, metavar=metavar, help=text)


def _samples(group: argparse._ArgumentGroup) -> None:
    _number(group, "noise-nm", "SD", "standard deviation of the sensor's white noise, N·m")
    group.add_argument("--noise-seed", type=int, metavar="SEED", help="of noise and faults (default: at random)")
    _number(group, "torque-offset-nm", "NM", "the cell's zero offset")
    _number(group, "rate-hz", "HZ", "samples per second")
    frames = "plain takes 1 or 3 (16-bit counts of 2 mN·m and a counter of frames), counts takes 1 to 4"
    _number(group, "samples-per-frame", "N", f"samples in each frame: {frames}")
    _number(group, "clock-ppm", "PPM", "drift of the cell's clock")
    jitter = "standard deviation of each sample's own time, never more than 0.45 of a period"
    _number(group, "clock-jitter-us", "SD", jitter)


def _arm(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--arm",
        metavar="MODE[,SETTING=NUMBER…]|FILE",
        help=f"what holds or moves the elbow: {', '.join(MOVERS)}, or a TOML or JSON file; with --hidden also "
        "'design', the movement that its effect was sized on (default: no arm, the joint is still and has no sensor)",
    )
    group.add_argument(
        "--arm-law",
        action="append",
        default=[],
        metavar="PLACE=NAME[,PARAMETER=NUMBER…]",
        help=f"another law of its tissue, at {', '.join(LAWS)}; may be repeated (default: "
        f"{', '.join(f'{place}={name}' for place, name in DEFAULT_LAWS.items())}; each place has 'none')",
    )
    group.add_argument(
        "--angle",
        choices=ANGLES,
        default=DEFAULTS.angle,
        help="the angle in frames of its own (id 0x182) or in the load cell's frame (default: %(default)s)",
    )
    _number(group, "angle-rate-hz", "HZ", "frames per second of its own")
    _number(group, "angle-bits", "BITS", "resolution of the encoder, bits per turn")
    _number(group, "angle-noise-deg", "SD", "standard deviation of its white noise, degrees")
    _number(group, "angle-offset-deg", "DEG", "its reading at the straight arm")
    _number(group, "angle-scale", "FACTOR", "true angle = direction × FACTOR × (reading − offset)")
    _number(group, "angle-clock-ppm", "PPM", "drift of its clock")
    _number(group, "angle-jitter-us", "SD", "standard deviation of each of its samples' own time")
    group.add_argument(
        "--angle-direction", type=int, choices=(1, -1), default=1, help="-1: its readings fall in flexion (default: 1)"
    )


def _process(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--speed", type=float, default=1.0, metavar="FACTOR", help="let time run FACTOR times faster, for tests"
    )
    group.add_argument("--no-json", action="store_true", help="print readable lines instead of the JSON line")
    group.add_argument("--die-with-parent", action="store_true", help="end when the process that started it does")
