"""The fault campaign: each fault, in each phase of a test, on several seeds; the table goes to docs/faults.md.

    python -m bench.faults [--short] [--injections N] [--minutes M] [--workers N] [--seed N] [--speed N] [--no-table]

An emulator at `speed` times the world's and a rig on it, for each worker. Times are real milliseconds: pulses come
`speed` times as often as they would, while the rig's watches wait for as long as they always do, so that a late stop
shows more easily here than at speed 1. Needs root for a full disk (a small tmpfs).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

from bench.faults_cases import CASES, PHASES
from bench.faults_judge import Verdict, table
from bench.faults_worker import Worker

DOCUMENT = Path(__file__).parents[1] / "docs" / "faults.md"
SHORT = 24


def order(injections: int, seed: int) -> list[tuple[str, str, int]]:
    """(fault, phase, number) of each injection: whole rounds of all faults in all phases, shuffled."""
    pairs = [(fault, phase) for fault in CASES for phase in PHASES]
    rng, jobs, round_ = random.Random(seed), [], 0
    while len(jobs) < injections:
        rng.shuffle(pairs)
        jobs += [(fault, phase, seed * 1000 + round_) for fault, phase in pairs]
        round_ += 1
    return jobs[:injections]


def campaign(
    jobs: list[tuple[str, str, int]],
    workers: int,
    speed: float,
    minutes: float,
    tell: bool = True,
    tell_all: bool = False,
) -> list[Verdict]:
    """Make the injections; stops early when the time is up."""
    waiting, found, lock = list(reversed(jobs)), [], threading.Lock()
    end_s = time.monotonic() + 60 * minutes

    def work(number: int) -> None:
        worker = Worker(number, speed)
        try:
            while time.monotonic() < end_s:
                with lock:
                    if not waiting:
                        return
                    job = waiting.pop()
                verdict = worker.inject(*job)
                with lock:
                    found.append(verdict)
                    if tell and (verdict.wrong or tell_all):
                        print(json.dumps(verdict.__dict__), flush=True)
                    if tell and len(found) % 50 == 0:
                        print(f"{len(found)} of {len(jobs)}", file=sys.stderr, flush=True)
        finally:
            worker.close()

    threads = [threading.Thread(target=work, args=(n,)) for n in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def main() -> None:
    """Run, print, write the table; exit 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--short", action="store_true", help=f"{SHORT} injections, no table")
    parser.add_argument("--injections", type=int, default=512)
    parser.add_argument("--minutes", type=float, default=12.0, help="stop after that long, whatever is left")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=4.0)
    parser.add_argument("--only", nargs="*", metavar="FAULT", help="these faults alone")
    parser.add_argument("--no-table", action="store_true")
    parser.add_argument("--all", action="store_true", help="print every injection as JSON, not only what went wrong")
    options = parser.parse_args()
    injections = SHORT if options.short else options.injections
    jobs = order(injections, options.seed)
    if options.only:
        jobs = [job for job in order(10_000, options.seed) if job[0] in options.only][: options.injections]
    load, began_s = os.getloadavg(), time.monotonic()
    found = campaign(jobs, options.workers, options.speed, options.minutes, tell_all=options.all)
    took_s = time.monotonic() - began_s
    conditions = (
        f"{len(found)} injections in {took_s / 60:.1f} min on {datetime.now(UTC):%Y-%m-%d}, seed {options.seed}, speed "
        f"{options.speed:g}, {options.workers} emulated rigs at once on {os.cpu_count()} processors "
        f"({platform.machine()}, Python {platform.python_version()}); load average {load[0]:.1f} before, "
        f"{os.getloadavg()[0]:.1f} after: other work ran beside it."
    )
    text = table(found, conditions)
    print(text)
    if not (options.short or options.no_table or options.only):
        DOCUMENT.write_text(text, "utf-8")
    sys.exit(1 if any(verdict.wrong for verdict in found) else 0)


if __name__ == "__main__":
    main()
