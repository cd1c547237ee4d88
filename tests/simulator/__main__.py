"""`python -m tests.simulator`: as many lives of a rig as fit; see docs/simulator.md.

Its last line is one JSON object. Exit 1 if anything broke: each broken life is told in one line, shrunk to the fewest
accidents that break it, with the command that replays it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import count, islice
from typing import NamedTuple

from tests.simulator.invariants import broken
from tests.simulator.life import Life

AHEAD = 4
"""Lives that are asked of each process before the first one is back."""


class Outcome(NamedTuple):
    """What became of one life."""

    seed: int
    wrong: list[str]
    faults: int
    decisions: int
    simulated_s: float
    digest: str


class Failures(logging.Handler):
    """Keeps what a rig logs with an exception: a mistake in its program, wherever it was caught."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.told: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.exc_info[1] is not None:
            self.told.append(f"{record.getMessage()}: {type(record.exc_info[1]).__name__}: {record.exc_info[1]}")


def live(seed: int, only: frozenset[int] | None = None) -> tuple[Life, list[str]]:
    """One life, and what did not hold in it; an exception counts."""
    failures, log = Failures(), logging.getLogger("rig")
    before, log.handlers, log.propagate = log.handlers, [failures], False
    life = Life(seed, only)
    try:
        life.live()
        return life, [*failures.told, *broken(life)]
    except Exception as error:
        return life, [f"{type(error).__name__}: {error}"]
    finally:
        log.handlers, log.propagate = before, True


def outcome_of(seed: int) -> Outcome:
    """For a pool of processes."""
    life, wrong = live(seed)
    return Outcome(seed, wrong, life.world.faults, len(life.clinic.asked), life.world.now_s, life.world.digest())


def shrink(seed: int) -> frozenset[int]:
    """The fewest accidents found with which the life of a seed still breaks: one after the other is left out."""
    life, _ = live(seed)
    kept = frozenset(range(life.accidents))
    for number in sorted(kept):
        if live(seed, kept - {number})[1]:
            kept -= {number}
    return kept


def main(arguments: list[str] | None = None) -> int:
    """The exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulator", description="Lives of a rig in simulated time.")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--lives", type=int, help="just so many, instead of minutes")
    parser.add_argument("--seed", type=int, default=1, help="of the first life; the next one has the next")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--first", action="store_true", help="end at the first life that breaks, do not shrink it")
    parser.add_argument("--replay", action="store_true", help="one life, with its trace")
    parser.add_argument("--only", type=_numbers, help="with --replay: numbers of the accidents that happen, as 3,7")
    options = parser.parse_args(arguments)
    return _replay(options) if options.replay else _simulate(options)


def _replay(options: argparse.Namespace) -> int:
    life, wrong = live(options.seed, options.only)
    print("\n".join(life.world.trace))
    print(json.dumps({"seed": options.seed, "wrong": wrong, "trace_sha256": life.world.digest()}))
    return 1 if wrong else 0


def _simulate(options: argparse.Namespace) -> int:
    began_s, digest = time.monotonic(), hashlib.sha256()
    lives = faults = decisions = 0
    simulated_s = told_s = 0.0
    broke: list[int] = []
    end_s = began_s + 60 * options.minutes
    seeds = islice(count(options.seed), options.lives) if options.lives else _until(end_s, options.seed)
    for outcome in _outcomes(seeds, options.processes):
        lives, faults, simulated_s = lives + 1, faults + outcome.faults, simulated_s + outcome.simulated_s
        decisions += outcome.decisions
        digest.update(outcome.digest.encode())
        if outcome.wrong:
            broke.append(outcome.seed)
            print(f"seed {outcome.seed} broke: {outcome.wrong[0]:.200}", flush=True)
            if options.first:
                break
        if time.monotonic() - told_s > 10:
            told_s = time.monotonic()
            print(f"{told_s - began_s:4.0f} s: {lives} lives, {faults} faults, {len(broke)} broken", flush=True)
    for seed in [] if options.first else broke[:5]:
        only = ",".join(map(str, sorted(shrink(seed))))
        print(f"replay: .venv/bin/python -m tests.simulator --replay --seed {seed} --only '{only}'")
    found = {
        "lives": lives, "faults": faults, "decisions": decisions, "broken": len(broke),
        "simulated_s": round(simulated_s, 3), "wall_s": round(time.monotonic() - began_s, 3),
        "trace_sha256": digest.hexdigest(),
    }  # fmt: skip
    print(json.dumps(found))
    return 1 if broke else 0


def _until(end_s: float, seed: int) -> Iterator[int]:
    for number in count(seed):
        if time.monotonic() >= end_s:
            return
        yield number


def _outcomes(seeds: Iterable[int], processes: int) -> Iterator[Outcome]:
    """In the order of the seeds."""
    if processes == 1:
        yield from map(outcome_of, seeds)
        return
    with ProcessPoolExecutor(processes) as pool:
        source, waiting = iter(seeds), []
        while True:
            more = islice(source, AHEAD * processes - len(waiting))
            waiting += [pool.submit(outcome_of, seed) for seed in more]
            if not waiting:
                return
            yield waiting.pop(0).result()


def _numbers(text: str) -> frozenset[int]:
    return frozenset(int(part) for part in text.split(",") if part.strip())


if __name__ == "__main__":
    sys.exit(main())
