"""`python -m tests`: every test, in lanes one after the other (`tests/runner/lanes.py`). `python -m tests fast`: one.

It tells its plan before, its progress meanwhile, and at the end the dearest tests and a command for each that failed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from tests.runner.costs import AGAIN, Costs, minutes
from tests.runner.lanes import CAMPAIGNS, LANES, Lane

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "build" / "tests"
"""What the tests of each lane cost in its last run."""
PLUGIN = ("-p", "tests.runner.costs")
TELLING = ("FAILED ", "ERROR ", "E  ", AGAIN)
"""How the lines begin that say what failed: printed once more at the end, where people look first."""
DEAREST = 10


def collected(folder: str = "tests") -> dict[str, set[str]]:
    """Every test and its markers.

    Raises
    ------
    ValueError
        If tests can't be collected; its text is pytest's.
    """
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "plan.json"
        command = [sys.executable, "-m", "pytest", *PLUGIN, "--plan", str(path), "--collect-only", "-qq", folder]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(done.stdout + done.stderr)
        return {test: set(markers) for test, markers in json.loads(path.read_text()).items()}


def plan(lanes: dict[str, Lane], tests: dict[str, set[str]]) -> str:
    """How many tests each lane runs, and how long it took the last time."""
    lines, whole_s = ["Plan:"], 0.0
    for name, lane in lanes.items():
        count = sum(lane.holds(test, markers) for test, markers in tests.items())
        last_s = Costs(KEPT / f"{name}.json").wall_s
        whole_s += last_s or 0.0
        took = "never run here" if last_s is None else f"{minutes(last_s)} the last time"
        lines.append(f"  {name:12} {count:5} tests, {took}")
    least = "at least " if any("never" in line for line in lines) else ""
    return "\n".join([*lines, f"  together     {least}{minutes(whole_s)}"])


def run(lanes: dict[str, tuple[str, ...]], failures: list[str], kept: Path = KEPT) -> dict[str, int]:
    """Run the lanes one after the other and print what they print as it comes.

    Parameters
    ----------
    lanes : dict
        pytest's arguments by the name of the lane.
    failures : list of str
        Lines that say what failed, and how it is repeated, are added to it.
    kept : Path
        Folder of what tests cost.

    Returns
    -------
    dict
        Each lane's exit code: 0 only if it ran tests and all of them passed.
    """
    codes = {}
    for name, arguments in lanes.items():
        try:
            codes[name] = follow(name, (*PLUGIN, "--costs", str(kept / f"{name}.json"), *arguments), failures)
        except (OSError, ValueError) as error:  # it could not be started: the others still run
            codes[name] = 1
            failures.append(f"[{name}] {error}")
    return codes


def follow(name: str, arguments: tuple[str, ...], failures: list[str]) -> int:
    """Run one lane; its exit code."""
    command = [sys.executable, "-m", "pytest", *arguments]
    began_s = time.monotonic()
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        assert process.stdout is not None
        for line in filter(str.strip, process.stdout):
            print(f"[{name}] {line}", end="", flush=True)
            if line.startswith(TELLING):
                failures.append(f"[{name}] {line.rstrip():.300}")
    print(f"[{name}] {minutes(time.monotonic() - began_s)}", flush=True)
    return process.returncode


def dearest(names: Iterable[str], kept: Path = KEPT) -> str:
    """What the dearest tests of some lanes cost."""
    costs = {test: cost_s for name in names for test, cost_s in Costs(kept / f"{name}.json").tests.items()}
    first = sorted(costs, key=lambda test: costs[test], reverse=True)[:DEAREST]
    return "\n".join(["Dearest tests:", *(f"  {costs[test]:6.1f} s  {test}" for test in first)])


def not_run() -> str:
    """What `python -m tests` leaves to campaigns, one line each."""
    return "\n".join(["Not run here:", *(f"  {command:14} {what}" for command, what in CAMPAIGNS.items())])


def main(names: list[str]) -> int:
    """Run all lanes, or those that are named; exit code 0 only if each ran tests and all of them passed."""
    if unknown := set(names) - set(LANES):
        print(f"No lane {', '.join(unknown)}. There are: {', '.join(LANES)}.", file=sys.stderr)
        return 2
    began_s = time.monotonic()
    lanes = {name: lane for name, lane in LANES.items() if name in names or not names}
    failures: list[str] = []
    tests: dict[str, set[str]] = {}
    if not names:
        try:
            tests = collected()
        except ValueError as error:
            print(error)
            return 1
        print(plan(lanes, tests), flush=True)
    codes = run({name: lane.arguments(tests) for name, lane in lanes.items()}, failures)
    print(dearest(lanes))
    if not names:
        print(not_run())
    # first the commands that repeat what failed would be lost among the rest
    for line in sorted(failures[-80:], key=lambda line: AGAIN in line):
        print(line)
    print(f"{minutes(time.monotonic() - began_s)}; exit codes {codes}")
    return 0 if set(codes.values()) == {0} else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
