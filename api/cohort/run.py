"""A run over many records: listed one after the other, a bounded number on Dask's workers, their rows in Parquet.

`run_cohort` is the entry point.
"""

from __future__ import annotations

import time
from asyncio import CancelledError
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

from distributed import Client, Future, as_completed
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker

from stimrig.api.cohort.cluster import connect, parse_memory
from stimrig.api.cohort.errors import RESUMABLE, SCHEDULER_GONE, CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT, Row, failed
from stimrig.api.cohort.results import COPY, Results
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, count_records, list_records
from stimrig.api.cohort.task import METHOD, Task
from stimrig.api.cohort.worker import Bounds, base_row, record_row
from stimrig.api.progress_bar import records_bar
from stimrig.api.version import software_version

IN_FLIGHT = 24
"""Records for each thread of a worker: none waits for its next, and the list is never in memory as a whole."""
DONE_BEFORE = "done before"
RETRIES = 2
"""Retries of a record that a worker could not begin; a record that fails by itself is a row and is not retried."""


def run_cohort(
    verb: str, data: Sequence[str], output: Path, *, select: str = "", method: str = METHOD,
    effects: Sequence[str] = (), scheduler: str = "", workers: int = 2, memory: str = "1GB", limit: float = 600.0,
    wait: float = 60.0, again: bool = False, columns: Sequence[str] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Do one verb with every record, and write the results; return the keys of `--json`.

    `verb`: fit, diagnose or improve; `data`: files, folders, addresses; `output`: Parquet file: if it has results of
    the same options, what is new is added. The others are options of the command line.

    Raises CohortError: an option is wrong, an address is missing, or a scheduler does not answer. InterruptedRunError:
    the run cannot go on.
    """
    task = Task(verb, Selection(select).text, method, tuple(effects), tuple(columns or ()), software_version())
    task.check()
    bounds = Bounds(limit, parse_memory(memory))
    total, began_s = count_records(data), time.monotonic()
    with Results(output, task, again) as results:
        with connect(scheduler, workers, wait) as client:
            counts = run_records(client, list_records(data), task, bounds, results, total)
        rows = results.join()
    return {
        "output": str(output),
        "records": rows["ok"] + rows["error"],
        "ok": rows["ok"],
        "errors": rows["error"],
        "computed": counts["ok"] + counts["error"],
        "done_before": counts[DONE_BEFORE],
        "left_out": counts[LEFT_OUT],
        "copies": rows[COPY],
        "took_s": round(time.monotonic() - began_s, 1),
    }


def run_records(
    client: Client, entries: Iterable[Entry], task: Task, bounds: Bounds, results: Results, total: int = 0
) -> Counter[str]:
    """Compute every record without a row on the client's workers; return counts by status, `done before` among them.

    `results` is open; the caller joins them. `total`: of the entries, for the bar.

    Raises CohortError: an address is missing, or a worker has another version. InterruptedRunError: the scheduler is
    gone, a worker cannot compute, or the disk is full.
    """
    counts, selection = Counter[str](), Selection(task.select)
    with records_bar(total) as bar:

        def is_open(entry: Entry) -> bool:
            if selection(entry.known) is False:
                status = LEFT_OUT
            elif results.has(entry):
                status = DONE_BEFORE
            else:
                return True
            counts[status] += 1
            bar.update()
            return False

        waiting, sent, pending = filter(is_open, entries), dict[Any, Entry](), as_completed()
        while True:
            threads: Any = client.nthreads()  # now: workers may come and go
            room = IN_FLIGHT * max(1, sum(threads.values())) - len(sent)
            if batch := list(islice(waiting, max(0, room))):
                futures = client.map(record_row, batch, task=task, bounds=bounds, pure=False, retries=RETRIES)
                sent.update((future.key, entry) for future, entry in zip(futures, batch, strict=True))
                pending.update(futures)
            if not sent:
                return counts
            for future in islice(pending, (len(sent) + 1) // 2):
                row = _result(client, future, sent.pop(future.key), task)
                counts[results.add({**row, "computed_utc": datetime.now(UTC)})] += 1
                bar.set_postfix_str(f"{counts['error']} failed" if counts["error"] else "", refresh=False)
                bar.update()


def _result(client: Client, future: Future[Row], entry: Entry, task: Task) -> Row:
    """Return a record's row, also where workers were lost with it. Raises CohortError: the run cannot go on."""
    try:
        return future.result()
    except KilledWorker:
        return base_row(entry, task) | failed("killed", "its workers were lost, one after the other.")
    except CohortError:
        raise
    except (Exception, CancelledError) as error:
        if isinstance(error, CancelledError | CommClosedError) or client.status != "running":
            raise InterruptedRunError(SCHEDULER_GONE) from None
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InterruptedRunError(f"a worker cannot compute ({reason}). {RESUMABLE}") from error
