"""What a worker of Dask does with a record: fetch it, and have a process with bounds on memory and time compute it.

That process is warm from record to record. A record that hangs it, fills its memory or crashes it costs its own row.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import resource
import signal
import tempfile
import threading
import time
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path, PurePath
from typing import Any

from distributed import get_worker

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.record import Row, compute_row, failed
from stimrig.api.cohort.sources import SUFFIXES, Entry, SourceError, read_content
from stimrig.api.cohort.task import Task
from stimrig.api.version import software_version

COPY = "copy"
"""Status of a record whose content is done already; it gets no row."""
RECORDS_PER_PROCESS = 500
"""After so many the process is replaced: what a library never gives back cannot add up."""
IDLE_S = 600.0
"""After so long without a record the process ends; a worker may outlive the run."""
LIBRARIES = (
    "stimrig.identify.fitting", "stimrig.identify.diagnosis.improvement", "stimrig.identify.records.csv",
    "stimrig.identify.records.mat", "stimrig.identify.records.recording", "pyarrow.parquet", "pyarrow.compute",
)  # fmt: skip
"""Loaded before memory is bounded, so that they are not counted as a record's."""


@dataclass(frozen=True)
class Bounds:
    """What one record may take."""

    limit_s: float = 600.0
    memory_bytes: int = 10**9  # beyond the libraries


def record_row(entry: Entry, known_contents: list[bytes], task: Task, bounds: Bounds) -> Row:
    """Return a record's row. Its status is `ok`, `error`, `left out`, or `copy` of one of the known contents.

    Raises CohortError: this worker has another version of stimrig than the run.
    """
    if (version := software_version()) != task.software:
        raise CohortError(f"a worker has stimrig {version}, here is {task.software}. Install the same version there.")
    row = base_row(entry, task)
    try:
        content = read_content(entry)
    except SourceError as error:
        return row | failed(error.kind, str(error))
    sha256 = hashlib.sha256(content).hexdigest()
    row |= {"bytes": len(content), "sha256": sha256}
    if digest(sha256) in known_contents:
        return row | {"status": COPY}
    return row | _compute(content, entry, task, bounds)


def base_row(entry: Entry, task: Task) -> Row:
    """Return what is known of a record before it is read."""
    return {
        **entry.known,
        "address": entry.address,
        "stamp": entry.stamp,
        "verb": task.verb,
        "software": task.software,
    }


def digest(*texts: str) -> bytes:
    """Return sixteen bytes that stand for texts: a run remembers every record."""
    return hashlib.blake2b("\0".join(texts).encode(), digest_size=16).digest()


def _compute(content: bytes, entry: Entry, task: Task, bounds: Bounds) -> Row:
    suffix = PurePath(entry.name).suffix.lower()
    with tempfile.NamedTemporaryFile(
        suffix=suffix if suffix in SUFFIXES else "",
        dir=get_worker().local_directory,  # Dask empties it once the worker is gone
    ) as file:
        file.write(content)
        file.flush()
        future = _submit(bounds, file.name, entry, task)
        began_s = time.monotonic()
        try:
            return future.result()
        except BrokenProcessPool:
            took_s = time.monotonic() - began_s
    if took_s >= bounds.limit_s:
        row = failed("timeout", f"ended after {bounds.limit_s:g} s. Give more with --limit, or cut the record.")
    else:
        row = failed("killed", "its process was killed, by the record or by the system for want of memory.")
    return row | {"took_s": round(took_s, 3)}


_of_thread = threading.local()


def _submit(bounds: Bounds, *arguments: Any) -> Future[Row]:
    """Submit a record to this thread's process; to a new one after it ended, or with other bounds."""
    if getattr(_of_thread, "bounds", None) == bounds:
        with contextlib.suppress(BrokenProcessPool):  # by the record before, or after a long idle time
            return _of_thread.pool.submit(_compute_within, bounds.limit_s, *arguments)
    multiprocessing.current_process().daemon = False  # Dask starts workers as daemons, which may have no children
    pool = ProcessPoolExecutor(
        1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_prepare_process,
        initargs=(bounds.memory_bytes,),
        max_tasks_per_child=RECORDS_PER_PROCESS,
    )
    pool.submit(os.getpid).result()  # raises here, not in a record's name, if the process cannot start
    _of_thread.pool, _of_thread.bounds = pool, bounds
    return pool.submit(_compute_within, bounds.limit_s, *arguments)


def _prepare_process(memory_bytes: int) -> None:
    """Load the libraries, bound the memory, and end with the worker; Ctrl-C is the run's to handle."""
    from stimrig.identify.diagnosis import side_by_side

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    worker = multiprocessing.parent_process()
    assert worker is not None
    threading.Thread(target=lambda: (worker.join(), os._exit(1)), daemon=True).start()
    for name in LIBRARIES:
        import_module(name)
    side_by_side.WORKERS = 1
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])  # of addresses, as RLIMIT_AS counts them
    limit_bytes = pages * resource.getpagesize() + memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _compute_within(limit_s: float, file: str, entry: Entry, task: Task) -> Row:
    """Compute a record's row; the system ends this process after the limit, whatever the process does."""
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        return compute_row(Path(file), entry.name, entry.known, task)
    finally:
        signal.setitimer(signal.ITIMER_REAL, IDLE_S)
