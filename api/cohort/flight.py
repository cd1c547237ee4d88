"""The records that are on the workers: sent, come back as rows, sent again where a worker was lost."""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from typing import Any

from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from api.cohort.errors import CohortError, CutOffError
from api.cohort.sources import Entry, Source
from api.cohort.tasks import Task
from api.cohort.worker import Bounds, lost, run_record

TRIES = 3
"""A record with which so many workers were lost is a row that says so."""
GOES_ON = "What is done is kept; the same command goes on."


@dataclass
class Sent:
    """One record on its way."""

    future: Future
    source: Source
    entry: Entry
    alike: tuple[bytes, ...]
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
        self.most = 0
        self._run = uuid.uuid4().hex
        self._number = 0
        self._sent: dict[str, Sent] = {}
        self._came = as_completed(with_results=True, raise_errors=False)

    def __len__(self) -> int:
        return len(self._sent)

    def send(self, source: Source, entry: Entry, alike: tuple[bytes, ...] = (), tries: int = 1) -> None:
        """Send a record to a worker; contents that are `alike` it need not be computed again."""
        self._number += 1
        key = f"record-{self._run}-{self._number}"  # a scheduler may hold what another run asked of it
        future = self.client.submit(run_record, source, entry, self.task, self.bounds, alike, key=key, pure=False)
        self._sent[key] = Sent(future, source, entry, alike, tries)
        self._came.add(future)
        self.most = max(self.most, len(self._sent))

    def receive(self) -> dict[str, Any]:
        """The next row that comes back.

        Raises
        ------
        CohortError
            A worker has another version.
        CutOffError
            The scheduler is gone, or a worker cannot compute at all.
        """
        while True:
            future, result = next(self._came)
            one = self._sent.pop(future.key)
            row = self._row(one, result)
            future.release()
            if row is not None:
                return row

    def _row(self, one: Sent, result: Any) -> dict[str, Any] | None:
        """The row of what came back; None where the record was sent again."""
        if isinstance(result, dict):
            if version := result.get("other_version"):
                here = self.task.software
                raise CohortError(f"a worker has stimrig {version}, here is {here}. Install the same version there.")
            return result
        error = result[1] if isinstance(result, tuple) else result
        if one.future.status == "error" and not isinstance(error, KilledWorker):
            words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise CutOffError(f"a worker cannot compute ({words}). {GOES_ON}")
        if isinstance(error, KilledWorker) or one.tries >= TRIES:
            return lost(one.entry, self.task, "its workers were lost, one after the other, while it was computed.")
        if self.client.status != "running":
            raise CutOffError(f"the scheduler is gone. {GOES_ON}")
        self.send(one.source, one.entry, one.alike, one.tries + 1)  # its worker was lost with the row
        return None

    def cancel(self) -> None:
        """Leave what is still on the workers."""
        if self._sent and self.client.status == "running":
            self.client.cancel([one.future for one in self._sent.values()])
        self._sent.clear()
