"""The command line of the emulator."""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Sequence
from typing import NoReturn

from hardware_sim import stimulators
from hardware_sim.load_cells import cells, transports
from hardware_sim.patients import registry
from hardware_sim.scan import modules_with
from hardware_sim.settings import Settings

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
    _who(parser.add_argument_group("the muscle"))
    devices = parser.add_argument_group("the devices")
    _devices(devices)
    _samples(devices)
    _process(parser.add_argument_group("the process"))
    return parser.parse_args(arguments)


def settings(options: argparse.Namespace, patient: str) -> Settings:
    """The checked settings of these options.

    Raises
    ------
    SettingsError
        A number is out of its range.
    """
    seed = secrets.randbelow(2**31) if options.noise_seed is None else options.noise_seed
    return Settings(
        patient=patient,
        stimulator=options.stimulator,
        cell=options.cell,
        transport=options.load_cell,
        noise_nm=options.noise_nm,
        noise_seed=seed,
        torque_offset_nm=options.torque_offset_nm,
        rate_hz=options.rate_hz,
        speed=options.speed,
        clock_ppm=options.clock_ppm,
        clock_jitter_us=options.clock_jitter_us,
        samples_per_frame=options.samples_per_frame,
        sync=not options.no_sync,
    )


def _who(group: argparse._ArgumentGroup) -> None:
    who = group.add_mutually_exclusive_group()
    who.add_argument(
        "--patient",
        default=DEFAULTS.patient,
        metavar="NAME|FILE",
        help=f"{', '.join(registry.names())}, or a TOML or JSON file with 'patient' and a table 'parameters' "
        "(default: %(default)s)",
    )
    who.add_argument("--hidden", type=int, metavar="SEED", help="a patient with a hidden effect, drawn by SEED")
    who.add_argument("--reveal", type=int, metavar="SEED", help="print what --hidden SEED hides, and exit")


def _devices(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--stimulator", default=DEFAULTS.stimulator, choices=modules_with(stimulators, "Firmware"))
    group.add_argument(
        "--load-cell",
        default=DEFAULTS.transport,
        choices=modules_with(transports, "Transport"),
        help="what carries the cell's frames: a server on 127.0.0.1, or an adapter on a pseudo-terminal "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--cell",
        default=DEFAULTS.cell,
        choices=modules_with(cells, "Cell"),
        help="the cell's frames (default: %(default)s: id 0x181, float32 N·m, counter, status)",
    )
    group.add_argument("--no-sync", action="store_true", help="no sync line from the stimulator to the cell")
    group.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[,SETTING=NUMBER…]",
        help="switch a fault on from the start; may be repeated",
    )


def _samples(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--noise-nm",
        type=float,
        default=DEFAULTS.noise_nm,
        metavar="SD",
        help="standard deviation of the sensor's white noise, N·m (default: %(default)s)",
    )
    group.add_argument("--noise-seed", type=int, metavar="SEED", help="of noise and faults (default: at random)")
    group.add_argument(
        "--torque-offset-nm", type=float, default=0.0, metavar="NM", help="the cell's zero offset (default: 0)"
    )
    group.add_argument(
        "--rate-hz",
        type=float,
        default=DEFAULTS.rate_hz,
        metavar="HZ",
        help="samples per second (default: %(default)g)",
    )
    group.add_argument(
        "--samples-per-frame",
        type=int,
        default=1,
        metavar="N",
        help="samples in each frame: plain takes 1 or 3 (16-bit counts of 2 mN·m and a counter of frames), "
        "counts takes 1 to 4 (default: 1)",
    )
    group.add_argument(
        "--clock-ppm", type=float, default=0.0, metavar="PPM", help="drift of the cell's clock (default: 0)"
    )
    group.add_argument(
        "--clock-jitter-us",
        type=float,
        default=0.0,
        metavar="SD",
        help="standard deviation of each sample's own time, never more than 0.45 of a period (default: 0)",
    )


def _process(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--speed", type=float, default=1.0, metavar="FACTOR", help="let time run FACTOR times faster, for tests"
    )
    group.add_argument("--no-json", action="store_true", help="print readable lines instead of the JSON line")
    group.add_argument("--die-with-parent", action="store_true", help="end when the process that started it does")
