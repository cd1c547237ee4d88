"""Plants the faults of tests/planted_faults.toml one at a time, and tells which part of the suite finds each.

    python -m bench.planted [--old TREE] [--only WORDS]

`--old`: a tree of commit c6ff60e; its tests of the rig are run against the same faults there. The tree of this file is
copied, never changed. Writes docs/results/planted.md where nothing is left out.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.common import RESULTS, ROOT, line, parser, table, written_by
from tests.harness.planted import copy_tree, places, plant, read_faults

TARGET = RESULTS / "planted.md"
LONGEST_S = 1200.0
"""A suite that hangs on a fault has found it."""
PYTEST = ("-m", "pytest", "-x", "-q", "-n", "2", "-p", "no:cacheprovider")
SIMULATOR = ("-m", "tests.simulator", "--seed", "900000", "--lives", "200", "--first")
UNITS = (*PYTEST, "-m", "not realtime and not wire", "tests/rig")
REST = (*PYTEST, "-m", "realtime or wire", "tests/rig", "tests/wire")


def finds(tree: Path, command: tuple[str, ...]) -> tuple[bool, float]:
    """Whether a command fails in a tree, and how long it took, s."""
    began_s = time.monotonic()
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    call = [sys.executable, *command]
    try:
        done = subprocess.run(call, cwd=tree, env=environment, capture_output=True, text=True, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        return True, time.monotonic() - began_s
    if done.returncode not in (0, 1) and "stopping after 1 failures" not in done.stdout:
        raise RuntimeError(f"{command}: exit code {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.returncode != 0, time.monotonic() - began_s


def searched(source: Path, fault: dict[str, Any], commands: dict[str, tuple[str, ...]], old: bool) -> dict[str, bool]:
    """Which of some commands find a fault: in their order, all of the new suite, up to the first of the old."""
    found = {}
    with tempfile.TemporaryDirectory(prefix="planted-") as folder:
        tree = Path(folder) / "tree"
        copy_tree(source, tree)
        for place in places(fault, old):
            plant(tree, *place, old)
        for name, command in commands.items():
            if old and any(found.values()):
                continue
            found[name], took_s = finds(tree, command)
            print(f"  {name}: {'found' if found[name] else 'not found'} in {took_s:.0f} s", flush=True)
    return found


def run(old: Path | None, only: str) -> None:
    """Measure, print, write."""
    faults = [fault for fault in read_faults() if only in fault["name"]]
    rows, totals = [], {"old": 0, "simulator": 0, "units": 0, "together": 0}
    for number, fault in enumerate(faults, start=1):
        print(f"{number} of {len(faults)}: {fault['name']}", flush=True)
        here = searched(ROOT, fault, {"simulator": SIMULATOR, "units": UNITS}, old=False)
        before = searched(old, fault, {"old units": UNITS, "old wire": REST}, old=True) if old else {}
        together = any(here.values())
        for name, found in (("old", any(before.values())), *here.items(), ("together", together)):
            totals[name] += found
        words = [_word(any(before.values())) if old else "–", *map(_word, here.values())]
        rows.append([fault["name"], *words])
    count = len(faults)
    lines = [
        "# Planted faults: which suite finds them",
        "",
        written_by("python -m bench.planted --old TREE"),
        "Each fault of `tests/planted_faults.toml` is planted alone. Old suite: tests of the rig and the wire at",
        "commit c6ff60e, up to the first that fails. Simulator: 200 lives from seed 900000, used here alone. Unit",
        "tests: `tests/rig` without what needs real time.",
        "",
        *table(["fault", "old suite", "simulator", "unit tests"], rows),
        line([f"**found of {count}**", totals["old"], totals["simulator"], totals["units"]]),
        "",
        f"Simulator and unit tests together: {totals['together']} of {count}.",
    ]
    print("\n".join(lines))
    if old and not only:
        TARGET.write_text("\n".join(lines) + "\n", "utf-8")


def _word(found: bool) -> str:
    return "found" if found else "not found"


if __name__ == "__main__":
    made = parser(__doc__)
    made.add_argument("--old", type=Path, help="a tree of commit c6ff60e")
    made.add_argument("--only", default="", help="only faults whose names hold these words")
    given = made.parse_args()
    run(given.old, given.only)
