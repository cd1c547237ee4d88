"""Work of a Dask worker on a record: fetch it, and have a process with limits compute it.

A record that hangs that process, fills its memory or crashes it costs its own row.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import tempfile
import threading
import time
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path, PurePath

from distributed import get_worker

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.record import Row, compute_row, failed
from stimrig.api.cohort.sources import SUFFIXES, Entry, SourceError, read_content
from stimrig.api.cohort.task import Task
from stimrig.api.jobs.process import Process
from stimrig.api.version import software_version

RECORDS_PER_PROCESS = 500
LIBRARIES = (
    "stimrig.identify.fitting", "stimrig.identify.diagnosis.improvement", "stimrig.identify.records.csv",
    "stimrig.identify.records.mat", "stimrig.identify.records.recording", "pyarrow.parquet", "pyarrow.compute",
)  # fmt: skip
"""Loaded before memory is limited, so that they are not counted as a record's."""


@dataclass(frozen=True)
class Bounds:
    """Limits of one record."""

    limit_s: float = 600.0
    memory_bytes: int = 10**9  # beyond the libraries


def record_row(entry: Entry, task: Task, bounds: Bounds) -> Row:
    """Return a record's row. Its status is `ok`, `error` or `left out`.

    Raises CohortError: this worker has another version of stimrig than the run.
    """
    if (version := software_version()) != task.software:
        raise CohortError(f"a worker has stimrig {version}, here is {task.software}. Install the same version there.")
    row = base_row(entry, task)
    try:
        content = read_content(entry)
    except SourceError as error:
        return row | failed(error.kind, str(error))
    row |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    return row | _compute(content, entry, task, bounds)


def base_row(entry: Entry, task: Task) -> Row:
    """Return what is known of a record before it is read."""
    about = {"address": entry.address, "stamp": entry.stamp, "verb": task.verb, "software": task.software}
    return {**entry.known, **about}


def _compute(content: bytes, entry: Entry, task: Task, bounds: Bounds) -> Row:
    suffix, process = PurePath(entry.name).suffix.lower(), _process(bounds)
    with tempfile.NamedTemporaryFile(
        suffix=suffix if suffix in SUFFIXES else "",
        dir=get_worker().local_directory,  # Dask empties it once the worker is gone
    ) as file:
        file.write(content)
        file.flush()
        began_s = time.monotonic()
        try:
            return process.submit(_row, file.name, entry, task).result(bounds.limit_s)
        except TimeoutError:
            process.kill()
            row = failed("timeout", f"ended after {bounds.limit_s:g} s. Give more with --limit, or cut the record.")
        except OSError as error:
            row = failed("unreadable", f"{type(error).__name__}: {error}")
        except BrokenProcessPool:
            row = failed("killed", "its process was killed, by the record or by the system for want of memory.")
    return row | {"took_s": round(time.monotonic() - began_s, 3)}


_of_thread = threading.local()


def _process(bounds: Bounds) -> Process:
    """Return this thread's process, warm from record to record; a new one after it ended, or with other bounds."""
    known, process = getattr(_of_thread, "process", (None, None))
    if process is None or known != bounds:
        if process is not None:
            process.close()
        multiprocessing.current_process().daemon = False  # Dask starts workers as daemons, which may have no children
        process = Process(LIBRARIES, bounds.memory_bytes, most_calls=RECORDS_PER_PROCESS)
        _of_thread.process = bounds, process
    if not process.ready:
        process.close()
        process.start().result()  # raises here, not in a record's name, if the process cannot start
    return process


def _row(file: str, entry: Entry, task: Task) -> Row:
    """Compute a record's row in the process."""
    from stimrig.identify.diagnosis import side_by_side

    side_by_side.WORKERS = 1  # the records themselves are computed in parallel
    return compute_row(Path(file), entry.name, entry.known, task)
