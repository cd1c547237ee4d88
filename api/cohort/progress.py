"""Progress of a run over many records: a bar at a terminal, a line a minute in a log."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from stimrig.api.cohort.sources import Entry
from stimrig.api.progress_bar import in_notebook

LOG_S = 60.0


@contextmanager
def progress_of(entries: Callable[[], Iterator[Entry]]) -> Iterator[Any]:
    """Show a tqdm bar on standard error, to be updated; the entries are counted beside it for the time that is left."""
    from tqdm.auto import tqdm

    watched = sys.stderr.isatty() or in_notebook()
    delay_s, interval_s = (1.0, 0.1) if watched else (LOG_S, LOG_S)
    ended = threading.Event()
    with tqdm(unit=" records", leave=not watched, delay=delay_s, mininterval=interval_s) as bar:

        def count() -> None:
            total = 0
            try:
                for _ in entries():
                    total += 1
                    if ended.is_set():
                        return
            except Exception:  # the run itself meets it, and says so
                return
            bar.total = total

        threading.Thread(target=count, daemon=True).start()
        try:
            yield bar
        finally:
            ended.set()
