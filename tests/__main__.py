"""`python -m tests`: every test, in lanes one after the other.

The first lane shares the processors among several test processes. The tests of the others keep time with an emulator,
so nothing that computes may stand beside them; those at the limits of real time have the machine for themselves.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

PROCESSORS = os.cpu_count() or 1
SIDE_BY_SIDE = ("--dist", "worksteal", "-n")
ON_POSTGRESQL = ("access", "archive", "controller_keys", "idle_lock", "names", "notes", "people", "session", "tracked")
LANES = {
    # more processes than processors: tests of the service wait half of their time
    "pure": ("-m", "not wire", *SIDE_BY_SIDE, str(PROCESSORS + 2), "tests"),
    # what several services share, and what the database decides; `make postgresql` runs all of it there
    "postgresql": (
        "--postgresql",
        "-m",
        "service and not browser and not wire and not slow",
        *SIDE_BY_SIDE,
        str(PROCESSORS + 2),
        *(f"tests/api/test_{name}.py" for name in ON_POSTGRESQL),
    ),
    # two emulated rigs leave half of two processors idle
    "wire": ("-m", "wire and not realtime", *SIDE_BY_SIDE, "2", "tests"),
    "realtime": ("-m", "realtime", "tests"),
}

CAMPAIGNS = {
    "make campaigns": "whole grids, of which one of each kind is run here; a hidden patient on the wire",
    "make postgresql": "every test of the service on PostgreSQL, of which nine files are run here",
    "make late": "the page's tests with answers that come late and in pieces",
    "make soak": "an hour of recording with fits beside it, of which 30 s are run here",
    "make faults": "every fault in every phase of a test, of which seven are run here",
    "make mutation": "changes of the rig's safety code, one by one: which of them no test sees",
    "make bench": "the figures in docs/, against other programs",
}
"""What is not run here, by the command that runs it."""

TELLING = ("FAILED ", "ERROR ", "E  ")
"""How the lines begin that say what failed: printed once more at the end, where people look first."""


def run(lanes: dict[str, tuple[str, ...]], failures: list[str]) -> dict[str, int]:
    """Run the lanes one after the other and print what they print as it comes.

    Parameters
    ----------
    lanes : dict
        pytest's arguments by the name of the lane.
    failures : list of str
        Lines that say what failed are added to it.

    Returns
    -------
    dict
        Each lane's exit code: 0 only if it ran tests and all of them passed.
    """
    codes = {}
    for name, arguments in lanes.items():
        try:
            codes[name] = follow(name, arguments, failures)
        except (OSError, ValueError) as error:  # it could not be started: the others still run
            codes[name] = 1
            failures.append(f"[{name}] {error}")
    return codes


def follow(name: str, arguments: tuple[str, ...], failures: list[str]) -> int:
    """Run one lane; its exit code."""
    command = [sys.executable, "-m", "pytest", "--durations=10", *arguments]
    began_s = time.monotonic()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(f"[{name}] {line}", end="", flush=True)
            if line.startswith(TELLING):
                failures.append(f"[{name}] {line.rstrip():.300}")
    print(f"[{name}] {time.monotonic() - began_s:.0f} s", flush=True)
    return process.returncode


def not_run() -> str:
    """What `python -m tests` leaves to campaigns, one line each."""
    return "\n".join(["Not run here:", *(f"  {command:14} {what}" for command, what in CAMPAIGNS.items())])


def main() -> int:
    """Exit code 0 only if each lane ran tests and all of them passed."""
    began_s = time.monotonic()
    failures: list[str] = []
    print(not_run(), flush=True)
    codes = run(LANES, failures)
    print(not_run())
    if failures:
        print("\n".join(failures[-40:]))
    print(f"{time.monotonic() - began_s:.0f} s; exit codes {codes}")
    return 0 if set(codes.values()) == {0} else 1


if __name__ == "__main__":
    sys.exit(main())
