"""The run: records listed one after the other, a bounded number of them on the workers, their rows to the disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from typing import Any

from distributed import Client

from stimrig.api.cohort.cluster import lanes
from stimrig.api.cohort.flight import Flight
from stimrig.api.cohort.parent import close_all
from stimrig.api.cohort.parts import Results
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Source
from stimrig.api.cohort.tasks import Task
from stimrig.api.cohort.worker import COPY, LEFT_OUT, Bounds, Record, identity

AHEAD = 3
"""Parcels sent for each that is computed: a worker never waits for its next, and none sees a million records."""
FLUSH_S = 10.0
"""What is lost at most, of the work done, when the run is killed."""
LANES_S = 5.0

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


@dataclass(eq=False)
class Run:
    """One run over a cohort.

    Parameters
    ----------
    client : Client
        With workers.
    sources : sequence of Source
        Where the records are.
    task : Task
        What is done with each.
    bounds : Bounds
        What one record may take.
    results : Results
        Open; takes the rows.
    tell : callable
        Called with the tally after every row.
    monotonic_s : callable
        The clock.
    """

    client: Client
    sources: Sequence[Source]
    task: Task
    bounds: Bounds
    results: Results
    tell: Tell = lambda _tally: None
    monotonic_s: Callable[[], float] = time.monotonic
    tally: Tally = field(default_factory=Tally)

    def __post_init__(self) -> None:
        self.selection = Selection(self.task.select)
        self.flight = Flight(self.client, self.task, self.bounds)
        self._ended = threading.Event()

    def go(self, keep: bool = False) -> Tally:
        """Do every record that is not done; then the results are whole, but not joined yet.

        Parameters
        ----------
        keep : bool
            Leave the workers' computing processes for another run.

        Raises
        ------
        CohortError
            A source is not there, or a worker has another version.
        CutOffError
            The scheduler, or a worker's machine, cannot go on.
        """
        counting = threading.Thread(target=self._count, daemon=True)
        counting.start()
        try:
            self._loop()
        finally:
            self._ended.set()
            self.results.flush()
            self.flight.cancel()
        if not keep:
            self.client.run(close_all)
        return self.tally

    def _loop(self) -> None:
        """Keep the workers in records, and take in rows, until there are no more."""
        open_entries, more = self._open(), True
        room = AHEAD * lanes(self.client)
        flushed_s = looked_s = self.monotonic_s()
        while True:
            while more and len(self.flight) < room:
                parcel = list(islice(open_entries, self.flight.size))
                if parcel:
                    self.flight.send(parcel)
                else:
                    more = False
            if not len(self.flight):
                return
            for row in self.flight.receive():
                self._add(row)
            now_s = self.monotonic_s()
            if now_s - flushed_s > FLUSH_S:
                self.results.flush()
                flushed_s = now_s
            if now_s - looked_s > LANES_S:
                room, looked_s = AHEAD * lanes(self.client), now_s

    def _open(self) -> Iterator[Record]:
        """Records that are meant, or may be, and that are not done."""
        for source in self.sources:
            for entry in source.entries(self.selection):
                if self.selection(entry.known) is False:
                    continue
                if self.results.done.has_place(entry):
                    self.tally.before += 1
                elif self.results.done.has_content(entry.sha256):
                    self._add({**identity(entry), "sha256": entry.sha256, "bytes": entry.bytes, "status": COPY})
                else:
                    yield source, entry, self.results.done.alike(entry)

    def _add(self, row: dict[str, Any]) -> None:
        if (left_open := row.pop("left_open", None)) and not self.tally.left_open:
            self.tally.left_open = ", ".join(f"{what} ({why})" for what, why in left_open.items())
        status = self.results.add({**row, "computed_utc": datetime.now(UTC)})
        name = {LEFT_OUT: "left_out", COPY: "copies"}.get(status, status)
        setattr(self.tally, name, getattr(self.tally, name) + 1)
        self.tell(self.tally)

    def _count(self) -> None:
        """Count what may be meant, beside the run, so that there is a time left to tell."""
        count = 0
        try:
            for source in self.sources:
                for entry in source.entries(self.selection):
                    if self._ended.is_set():
                        return
                    count += self.selection(entry.known) is not False
        except Exception:  # the run itself meets it, and says so
            return
        self.tally.total = count
