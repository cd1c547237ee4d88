"""Which injections a campaign makes, in which order, and making them on several emulated rigs at once."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable

from tests.harness.campaign.cases import CASES, PHASES
from tests.harness.campaign.judge import Verdict
from tests.harness.campaign.worker import Worker

Job = tuple[str, str, int]
"""Fault, phase and number of an injection."""


def order(injections: int, seed: int) -> list[Job]:
    """(fault, phase, number) of each injection: whole rounds of all faults in all phases, shuffled."""
    pairs = [(fault, phase) for fault in CASES for phase in PHASES]
    rng, jobs, round_ = random.Random(seed), [], 0
    while len(jobs) < injections:
        rng.shuffle(pairs)
        jobs += [(fault, phase, seed * 1000 + round_) for fault, phase in pairs]
        round_ += 1
    return jobs[:injections]


def campaign(
    jobs: list[Job],
    workers: int,
    speed: float,
    minutes: float,
    told: Callable[[Verdict], None] = lambda _: None,
    ending: threading.Event | None = None,
    make_worker: Callable[[int, float], Worker] = Worker,
) -> list[Verdict]:
    """Make the injections.

    Parameters
    ----------
    minutes
        Begin none after that long.
    told
        Called with each verdict, one at a time.
    ending
        Begin none once it is set.
    make_worker
        Given a number and the speed, the worker that makes injections one after another.
    """
    waiting, found, lock = list(reversed(jobs)), [], threading.Lock()
    end_s = time.monotonic() + 60 * minutes
    ending = ending or threading.Event()

    def work(number: int) -> None:
        worker = make_worker(number, speed)
        try:
            while time.monotonic() < end_s and not ending.is_set():
                with lock:
                    if not waiting:
                        return
                    job = waiting.pop()
                verdict = worker.inject(*job)
                with lock:
                    found.append(verdict)
                    told(verdict)
        finally:
            worker.close()

    threads = [threading.Thread(target=work, args=(n,)) for n in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found
