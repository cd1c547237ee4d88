"""Tasks shared by forked copies of this process, where the system can fork.

Threads would not help: between two compiled functions each of them needs the interpreter lock.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

from numba.core.compiler_lock import global_compiler_lock

WORKERS = min(2, os.cpu_count() or 1)
"""Copies that share the tasks; with 1 this process does them itself."""
DEATH_SIGNAL = 1
"""Linux, prctl: the signal that a process gets when its parent dies."""
_work: Callable[[int], Any] | None = None
"""The function of a copy's tasks: a closure, which a copy has from the fork."""


def side_by_side(work: Callable[[int], Any], count: int) -> Iterator[tuple[int, Any]]:
    """Yield the number and the result of each of `count` tasks as it is done. Results must be picklable.

    Tasks of copies that end early are done again here.
    """
    waiting = dict.fromkeys(range(count))
    if WORKERS > 1 and count > 1 and sys.platform == "linux" and not multiprocessing.current_process().daemon:
        for number, result in _by_copies(work, count):
            del waiting[number]
            yield number, result
    for number in waiting:
        yield number, work(number)


def _by_copies(work: Callable[[int], Any], count: int) -> Iterator[tuple[int, Any]]:
    """Yield the results that copies of this process give; some are missing where a copy was killed."""
    global _work
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool

    pool = ProcessPoolExecutor(WORKERS, multiprocessing.get_context("fork"), initializer=_begin)
    try:
        # If another thread held the compiler lock during the fork, the copy would wait for it for ever.
        with global_compiler_lock:
            _work = work
            numbers = {pool.submit(_do, number): number for number in range(count)}
        for done in as_completed(numbers):
            yield numbers[done], done.result()
    except (BrokenProcessPool, OSError):  # a copy was killed, or there are too many processes
        return
    finally:
        pool.shutdown(cancel_futures=True)


def _do(number: int) -> Any:
    assert _work is not None
    return _work(number)


def _begin() -> None:
    """Set up a copy: it dies with its parent, and keeps none of its streams, whose reader would wait for it."""
    import ctypes

    ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silent, stream)
