"""Tasks done in parallel by this process and forked copies of it, where the system can fork.

Threads would not help: between two compiled functions each of them needs the interpreter lock.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

from numba.core.compiler_lock import global_compiler_lock

WORKERS = min(2, os.cpu_count() or 1)
"""Processes that share tasks, this one included."""
ROOM_BYTES = 2**20
LOOKS_S = 1.0
"""So often a copy looks whether its parent still lives."""
Copy = tuple[Any, Any]
"""A process, and the end of a pipe from which its results come."""


def side_by_side(work: Callable[[int], Any], count: int, processes: int = 0) -> Iterator[tuple[int, Any]]:
    """Yield the number and the result of each task as it is done. Results must be picklable.

    A task that fails in a copy, or whose copy ends early, is done again here, so that its error is raised here.

    `work`: called with the number of a task. `count`: of tasks, 256 at most: each number is one byte. `processes`:
    processes that share the tasks, this one included; 0 for `WORKERS`.
    """
    numbers, write_end = os.pipe()
    os.write(write_end, bytes(range(count)))
    os.close(write_end)
    copies: list[Copy] = []
    waiting = set(range(count))
    try:
        while len(copies) + 1 < min(processes or WORKERS, count) and (copy := _copy(work, numbers)):
            copies.append(copy)
        while number := os.read(numbers, 1):
            waiting.discard(number[0])
            yield number[0], work(number[0])
            for _, results in copies:
                yield from _come(results, waiting, wait=False)
        for _, results in copies:
            yield from _come(results, waiting, wait=True)
        for number in sorted(waiting):
            yield number, work(number)
    finally:
        os.close(numbers)
        for process, results in copies:
            process.kill()
            process.join()
            results.close()


def _come(results: Any, waiting: set[int], *, wait: bool) -> Iterator[tuple[int, Any]]:
    """Results of a copy: those that are there, or, with `wait`, all until it ends."""
    try:
        while wait or results.poll():
            number, result = results.recv()
            waiting.discard(number)
            yield number, result
    except (EOFError, OSError):  # it ended; OSError: in the middle of a result
        pass


def _copy(work: Callable[[int], Any], numbers: int) -> Copy | None:
    """A forked copy of this process that does tasks; None if it cannot be made."""
    if sys.platform != "linux":
        return None
    import fcntl  # not there on every system

    results, result_writer = multiprocessing.Pipe(duplex=False)
    with contextlib.suppress(OSError):
        # Room for one or two results, so that a copy need not wait until this process has finished its own task.
        fcntl.fcntl(result_writer.fileno(), fcntl.F_SETPIPE_SZ, ROOM_BYTES)
    process = multiprocessing.get_context("fork").Process(
        target=_work, args=(work, numbers, result_writer), daemon=True
    )
    try:
        # If another thread held the compiler lock during the fork, the copy would wait for it for ever.
        with global_compiler_lock:
            process.start()
    except (OSError, AssertionError):  # too many processes; a daemon may have none
        results.close()
        return None
    finally:
        result_writer.close()
    return process, results


def _work(work: Callable[[int], Any], numbers: int, result_writer: Any) -> None:
    """Main function of a copy: do tasks while there are any and the parent process lives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The copy must not keep the parent's output streams open: their reader would wait for the copy to end.
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silent, stream)
    parent = os.getppid()

    def end_with_parent(*_: object) -> None:
        if os.getppid() != parent:
            os._exit(1)

    # Whoever kills the parent knows nothing of its copies, and one may wait for what will never come.
    signal.signal(signal.SIGALRM, end_with_parent)
    signal.setitimer(signal.ITIMER_REAL, LOOKS_S, LOOKS_S)
    while number := os.read(numbers, 1):
        end_with_parent()
        result_writer.send((number[0], work(number[0])))
