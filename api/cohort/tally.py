"""How far a run over many records is, and of how many."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Source

Tell = Callable[["Tally"], None]


@dataclass
class Tally:
    """How far a run is."""

    total: int | None = None
    """Records that may be meant; None until they are counted."""
    before: int = 0
    """Done by an earlier run."""
    ok: int = 0
    error: int = 0
    left_out: int = 0
    copies: int = 0
    left_open: str = ""
    """What the workers' computing processes could not be shut in from; empty: nothing."""

    @property
    def now(self) -> int:
        """Records that came back in this run."""
        return self.ok + self.error + self.left_out + self.copies

    @property
    def handled(self) -> int:
        """Records that need nothing more."""
        return self.now + self.before


@contextmanager
def counting(tally: Tally, sources: Sequence[Source], selection: Selection) -> Iterator[None]:
    """Count what may be meant, beside the run, so that there is a time left to tell."""
    ended = threading.Event()

    def count() -> None:
        total = 0
        try:
            for source in sources:
                for entry in source.entries():
                    if ended.is_set():
                        return
                    total += selection(entry.known) is not False
        except Exception:  # the run itself meets it, and says so
            return
        tally.total = total

    threading.Thread(target=count, daemon=True).start()
    try:
        yield
    finally:
        ended.set()
