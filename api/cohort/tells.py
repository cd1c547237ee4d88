"""How far a run is, for who waits: a bar at a terminal, a line a minute in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from api.cohort.run import Tally, Tell
from api.progress_bar import in_notebook, progress_bar

EVERY_S = 60.0
LEAST_S = 5.0
"""Before there is no pace to tell a time from."""


@contextmanager
def telling(dashboard: str = "", monotonic_s: Callable[[], float] = time.monotonic) -> Iterator[Tell]:
    """A function that shows a tally on standard error.

    Parameters
    ----------
    dashboard : str
        Address of Dask's dashboard, said first; empty: none.
    monotonic_s : callable
        The clock.
    """
    if dashboard:
        print(f"dashboard      {dashboard}", file=sys.stderr, flush=True)
    watched = sys.stderr.isatty() or in_notebook()
    began_s = told_s = monotonic_s()
    with progress_bar() as bar:

        def tell(tally: Tally) -> None:
            nonlocal told_s
            now_s = monotonic_s()
            if watched:
                bar(share(tally), words(tally, now_s - began_s))
            elif now_s - told_s >= EVERY_S:
                told_s = now_s
                print(words(tally, now_s - began_s), file=sys.stderr, flush=True)

        yield tell


def share(tally: Tally) -> float:
    """The share that is done; 0 while it is not known of how much."""
    return min(1.0, tally.handled / tally.total) if tally.total else 0.0


def words(tally: Tally, elapsed_s: float) -> str:
    """A tally in one line."""
    of = "" if tally.total is None else f" of {tally.total}"
    failed = f", {tally.error} failed" if tally.error else ""
    if elapsed_s < LEAST_S or not tally.now:
        return f"{tally.handled}{of}{failed}"
    pace = tally.now / elapsed_s
    left_s = None if tally.total is None else max(0.0, (tally.total - tally.handled) / pace)
    return f"{tally.handled}{of}{failed}, {pace:.3g}/s" + ("" if left_s is None else f", {duration(left_s)} left")


def duration(seconds: float) -> str:
    """A duration in two units at most."""
    minutes = seconds / 60
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes // 60:.0f} h {minutes % 60:.0f} min"
