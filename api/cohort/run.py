"""The run: records listed one after the other, a bounded number on the workers, their rows to the disk.

Records travel in parcels, come back as rows, and are sent again where a worker was lost.
"""

from __future__ import annotations

import time
import uuid
from asyncio import CancelledError
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from typing import Any

from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from stimrig.api.cohort.cluster import lanes
from stimrig.api.cohort.computing import COPY, LEFT_OUT, Bounds, Done, Record, close_all, lost, run_parcel
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Source
from stimrig.api.cohort.tally import Tally, Tell, counting
from stimrig.api.cohort.tasks import GOES_ON, SCHEDULER_GONE, CohortError, CutOffError, Task

TRIES = 3
"""A record with which so many workers were lost is a row that says so."""
PARCEL_S, LARGEST_PARCEL = 0.5, 8
"""A parcel ends after so long: sending a record alone costs more than reading it. Long records travel alone."""


@dataclass
class Sent:
    """Records on their way together."""

    future: Future
    records: list[Record]
    tries: int


class Parcels:
    """Records on the workers of one run.

    `client`: with workers; `task`, `bounds`: what is done with each, and what it may take.
    """

    def __init__(self, client: Client, task: Task, bounds: Bounds) -> None:
        self.client, self.task, self.bounds = client, task, bounds
        self.size = 1
        """How many records the next parcel should hold: more while they come back soon."""
        self.most = 0
        """So many records were on their way at the same time."""
        self._run = uuid.uuid4().hex
        self._number = 0
        self._sent: dict[str, Sent] = {}
        self._came = as_completed()  # with results it would never give back what a lost worker took along

    def __len__(self) -> int:
        return len(self._sent)

    def send(self, records: list[Record], tries: int = 1) -> None:
        """Send records to a worker, in one parcel."""
        self._number += 1
        key = f"parcel-{self._run}-{self._number}"  # a scheduler may hold what another run asked of it
        future = self.client.submit(run_parcel, records, self.task, self.bounds, PARCEL_S, key=key, pure=False)
        self._sent[key] = Sent(future, records, tries)
        self._came.add(future)
        self.most = max(self.most, sum(len(one.records) for one in self._sent.values()))

    def receive(self) -> list[dict[str, Any]]:
        """The rows of the next parcel that comes back; none where its records were sent again.

        Raises CohortError: a worker has another version. CutOffError: the scheduler is gone, or a worker cannot compute
        at all.
        """
        future = next(self._came)
        one = self._sent.pop(future.key)
        try:
            rows = self._came_back(one, future.result())
        except CohortError:
            raise
        except (Exception, CancelledError) as error:
            rows = self._lost(one, error)
        future.release()
        return rows

    def _came_back(self, one: Sent, done: Done) -> list[dict[str, Any]]:
        """The rows; what was not begun is sent again, each record alone."""
        if done.other_version:
            here = self.task.software
            raise CohortError(
                f"a worker has stimrig {done.other_version}, here is {here}. Install the same version there."
            )
        left = one.records[len(done.rows) :]
        if left:
            self.size = 1
        elif done.took_s < PARCEL_S / 2 and len(one.records) == self.size:
            self.size = min(2 * self.size, LARGEST_PARCEL)
        for record in left:
            self.send([record], one.tries)
        return done.rows

    def _lost(self, one: Sent, error: BaseException) -> list[dict[str, Any]]:
        """A worker was lost with the parcel: its records are sent again, each alone, or have had their tries."""
        if one.future.status == "error" and not isinstance(error, KilledWorker):
            words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise CutOffError(f"a worker cannot compute ({words}). {GOES_ON}")
        alone = len(one.records) == 1
        if alone and (isinstance(error, KilledWorker) or one.tries >= TRIES):
            _source, entry, _alike = one.records[0]
            return [lost(entry, self.task, "its workers were lost, one after the other, while it was computed.")]
        if self.client.status != "running":
            raise CutOffError(SCHEDULER_GONE)
        for record in one.records:
            self.send([record], one.tries + 1)
        return []

    def cancel(self) -> None:
        """Leave what is still on the workers."""
        if self._sent and self.client.status == "running":
            self.client.cancel([one.future for one in self._sent.values()])
        self._sent.clear()


AHEAD = 3
"""Parcels sent for each that is computed: a worker never waits for its next, and none sees a million records."""
FLUSH_S = 10.0
"""What is lost at most, of the work done, when the run is killed."""
LANES_S = 5.0


@dataclass(eq=False)
class Run:
    """One run over a cohort."""

    client: Client  # with workers
    sources: Sequence[Source]  # where the records are
    task: Task  # what is done with each
    bounds: Bounds  # what one record may take
    results: Results  # open; takes the rows
    tell: Tell = lambda _tally: None  # called with the tally after every row
    monotonic_s: Callable[[], float] = time.monotonic  # the clock
    tally: Tally = field(default_factory=Tally)

    def __post_init__(self) -> None:
        self.selection = Selection(self.task.select)
        self.parcels = Parcels(self.client, self.task, self.bounds)

    def go(self, keep: bool = False) -> Tally:
        """Do every record that is not done; then the results are whole, but not joined yet.

        `keep`: leave the workers' computing processes for another run. Raises CohortError: a source is not there, or a
        worker has another version.
        """
        try:
            with counting(self.tally, self.sources, self.selection):
                self._loop()
        finally:
            self.results.flush()
            self.parcels.cancel()
        if not keep:
            self.client.run(close_all)
        return self.tally

    def _loop(self) -> None:
        """Keep the workers in records, and take in rows, until there are no more."""
        open_entries, more = self._open(), True
        room = AHEAD * lanes(self.client)
        flushed_s = looked_s = self.monotonic_s()
        while True:
            while more and len(self.parcels) < room:
                parcel = list(islice(open_entries, self.parcels.size))
                if parcel:
                    self.parcels.send(parcel)
                else:
                    more = False
            if not len(self.parcels):
                return
            for row in self.parcels.receive():
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
            for entry in source.entries():
                if self.selection(entry.known) is False:
                    continue
                if self.results.done.has_place(entry):
                    self.tally.before += 1
                else:
                    yield source, entry, self.results.done.alike(entry)

    def _add(self, row: dict[str, Any]) -> None:
        if (left_open := row.pop("left_open", None)) and not self.tally.left_open:
            self.tally.left_open = ", ".join(f"{what} ({why})" for what, why in left_open.items())
        status = self.results.add({**row, "computed_utc": datetime.now(UTC)})
        name = {LEFT_OUT: "left_out", COPY: "copies"}.get(status, status)
        setattr(self.tally, name, getattr(self.tally, name) + 1)
        self.tell(self.tally)
