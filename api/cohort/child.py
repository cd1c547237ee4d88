"""The process that computes for a worker: shut in before it reads a record, one call a line, each way.

    {"file": "record.h5", "name": …, "known": {…}, "task": {…}, "limit_s": …} in, as one line of JSON;
    {"left_out": true} or {"row": {…}} out

A record may hang it, fill its memory or crash it: then this process ends, and its parent (`api.cohort.parent`) makes a
row of how. It ends by itself when its parent does, whatever it computes then, and when nobody calls for long.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import resource
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cohort.answers import answer
from stimrig.api.cohort.fields import as_day
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.tasks import Task
from stimrig.api.version import software_version
from stimrig.api.workers import confinement
from stimrig.api.workers.child import own_output, say
from stimrig.api.workers.json_values import clean
from stimrig.identify.diagnosis import candidates
from stimrig.identify.errors import BadRecord, BadRequest, IdentifyError, NotIdentifiable
from stimrig.identify.records import HDF5_MAGIC, bounds
from stimrig.identify.records.hdf5 import StrictFile

IDLE_S = 600.0
"""A worker that outlives the run keeps no process for longer."""
ABOUT = {
    "participant": "participant", "kind": "kind", "created_utc": "begun_utc", "recording_id": "record_id",
    "test_id": "test_id", "outcome": "outcome", "software": "recorded_by",
}  # fmt: skip
"""Attributes of a sealed recording, and the columns that repeat them."""
SAID = ("participant", "day", "kind", "rig", "record_id", "test_id", "outcome")
LIBRARIES = (
    "stimrig.identify.fitting", "stimrig.identify.diagnosis.experiment", "stimrig.identify.diagnosis.improvement",
    "stimrig.identify.records.csv", "stimrig.identify.records.mat", "stimrig.identify.records.recording",
)  # fmt: skip
KINDS: tuple[tuple[type[IdentifyError], str], ...] = (
    (BadRecord, "bad record"), (NotIdentifiable, "not identifiable"), (BadRequest, "bad request"),
)  # fmt: skip


def main() -> None:
    """Serve calls until the input closes."""
    parser = argparse.ArgumentParser(prog="stimrig.api.cohort.child")
    parser.add_argument("--folder", type=Path, required=True, help="where records are put, all that may be read")
    parser.add_argument("--memory", type=int, required=True, help="bytes beyond what the libraries take")
    options = parser.parse_args()
    out = own_output()
    load()
    os.chdir(options.folder)
    before, _ = taken() or (confinement.MEMORY_BYTES, 0)
    left_open = confinement.confine([options.folder], memory_bytes=before + options.memory)
    say(out, {"ready": True, "left_open": left_open, "software": software_version()})
    calls: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(calls,), daemon=True).start()
    while True:
        try:
            line = calls.get(timeout=IDLE_S)
        except queue.Empty:
            return
        say(out, run(json.loads(line)))


def listen(calls: queue.SimpleQueue[str]) -> None:
    """Take in calls; end this process as soon as its parent is gone, in the middle of a fit, too."""
    for line in sys.stdin:
        calls.put(line)
    os._exit(0)


def load() -> None:
    """Load the libraries, so that what they take is not counted as a record's; one process computes, no copies."""
    for name in LIBRARIES:
        import_module(name)
    candidates.WORKERS = 1


def taken() -> tuple[int, int] | None:
    """Bytes of addresses, and of memory, that this process has taken; None where the system does not tell."""
    try:
        addresses, memory = Path("/proc/self/statm").read_text("ascii").split()[:2]
    except OSError:
        return None
    return int(addresses) * resource.getpagesize(), int(memory) * resource.getpagesize()


def run(call: dict[str, Any]) -> dict[str, Any]:
    """Do one call. Whatever goes wrong is a row."""
    task = Task.of(call["task"])
    name, shown = str(call["file"]), str(call["name"])
    row: dict[str, Any] = dict(call["known"])
    began_s, processor_s = time.perf_counter(), time.process_time()
    confinement.limit_time(2 * float(call["limit_s"]))  # the parent ends it sooner; this is for when there is none
    try:
        if not found(Path(name), task, row):
            return {"left_out": True}
    except IdentifyError as error:
        kind = next((word for type_, word in KINDS if isinstance(error, type_)), "bad record")
        row |= failed(kind, str(error).replace(name, shown))
    except MemoryError:
        row |= failed("out of memory", "it takes more memory than a worker may have. Give more with --memory.")
    except RecursionError:
        row |= failed("unexpected", "too deeply nested")
    except Exception as error:
        row |= failed("unexpected", f"{type(error).__name__}: {error}")
    now = taken()
    row |= {
        "took_s": round(time.perf_counter() - began_s, 4),
        "processor_s": round(time.process_time() - processor_s, 4),
        "worker_memory_mb": now and round(now[1] / 1e6, 1),
    }
    return {"row": clean(row)}


def found(path: Path, task: Task, row: dict[str, Any]) -> bool:
    """Read, judge and do the verb, into the row; False where the selection does not mean the record."""
    with path.open("rb") as file:
        sealed = file.read(len(HDF5_MAGIC)) == HDF5_MAGIC
    selection = Selection(task.select)
    if sealed:
        row |= about(path)
        row |= {name: row.get(name) for name in SAID}  # what it does not say is known not to be said
        if selection(row) is False:
            return False
    record = identify.read(path, map=list(task.columns) if task.columns and not sealed else None)
    row |= {name: row.get(name) for name in SAID}
    row |= {
        "duration_s": round(float(record.time_s[-1] - record.time_s[0]), 4),
        "rate_hz": round(float(record.sample_rate_hz), 4),
        "notes": list(record.notes),
    }
    if selection(row) is False:
        return False
    row |= answer(record, task)
    row["status"] = "ok"
    return True


def about(path: Path) -> dict[str, Any]:
    """What a sealed recording says of itself."""
    file = StrictFile(bounds.content_of(path), str(path))
    given: dict[str, Any] = {column: file.text(name, "") for name, column in ABOUT.items()}
    given["day"] = as_day(given["begun_utc"])
    return {name: value for name, value in given.items() if value}


def failed(kind: str, line: str) -> dict[str, Any]:
    """The columns of a record that failed."""
    return {"status": "error", "error_kind": kind, "error": " ".join(line.split())[:1000]}


if __name__ == "__main__":
    try:
        main()
    except BrokenPipeError:  # the parent has ended: nobody listens any more
        os._exit(0)
