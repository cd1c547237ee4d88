"""Plants the faults of tests/planted_faults.toml one at a time, and prints which part of the suite finds each.

    python -m bench.planted [--only WORDS]

The tree of this file is copied, never changed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from bench.common import ROOT, bench_parser, line, table
from tests.harness.planted import copy_tree, places, plant, read_faults

LONGEST_S = 1200.0
"""A suite that hangs on a fault has found it."""
SUITES = {
    "simulator": ("-m", "tests.simulator", "--seed", "900000", "--lives", "200", "--first"),
    "unit tests": ("-m", "pytest", "-x", "-q", "-n", "2", "-p", "no:cacheprovider",
                   "-m", "not wire", "tests/rig"),
}  # fmt: skip


def finds(tree: Path, command: tuple[str, ...]) -> bool:
    """Tell whether a command fails in a tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    call = [sys.executable, *command]
    try:
        done = subprocess.run(call, cwd=tree, env=environment, capture_output=True, text=True, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        return True
    if done.returncode not in (0, 1) and "stopping after 1 failures" not in done.stdout:
        raise RuntimeError(f"{command}: exit code {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.returncode != 0


def main() -> None:
    """Plant each fault and print the table."""
    parser = bench_parser(__doc__)
    parser.add_argument("--only", default="", help="only faults whose names hold these words")
    only = parser.parse_args().only
    totals = dict.fromkeys(SUITES, 0)
    print(*table(["fault", *SUITES], []), sep="\n")
    for fault in read_faults():
        if only not in fault["name"]:
            continue
        with tempfile.TemporaryDirectory(prefix="planted-") as folder:
            tree = Path(folder) / "tree"
            copy_tree(ROOT, tree)
            for place in places(fault):
                plant(tree, *place)
            detected = {name: finds(tree, command) for name, command in SUITES.items()}
        for name, caught in detected.items():
            totals[name] += caught
        print(line([fault["name"], *("found" if caught else "not found" for caught in detected.values())]), flush=True)
    print(line(["**found**", *totals.values()]))


if __name__ == "__main__":
    main()
