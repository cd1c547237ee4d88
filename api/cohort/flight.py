"""The records that are on the workers: sent in parcels, come back as rows, sent again where a worker was lost."""

from __future__ import annotations

import uuid
from asyncio import CancelledError
from dataclasses import dataclass
from typing import Any

from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from stimrig.api.cohort.errors import GOES_ON, SCHEDULER_GONE, CohortError, CutOffError
from stimrig.api.cohort.tasks import Task
from stimrig.api.cohort.worker import Bounds, Done, Record, lost, run_parcel

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


class Flight:
    """Records on the workers of one run.

    Parameters
    ----------
    client : Client
        With workers.
    task, bounds : Task, Bounds
        What is done with each, and what it may take.
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
        """Parcels on their way."""
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

        Raises
        ------
        CohortError
            A worker has another version.
        CutOffError
            The scheduler is gone, or a worker cannot compute at all.
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
