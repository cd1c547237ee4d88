"""A worker process: limits itself, then does one verb at a time and reports progress through a pipe.

It reads files that anybody with the right to upload may have made. A file that exhausts one of the limits, hangs or
crashes the process costs its job; `stimrig.api.jobs.worker` starts another process.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import resource
import signal
from importlib import import_module
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import Any

from stimrig.api import logs
from stimrig.identify.errors import IdentifyError

log = logging.getLogger("stimrig.worker")

MEMORY_BYTES = 2 * 2**30
"""Three times what the largest record takes."""
FILE_BYTES = 512 * 2**20
OPEN_FILES = 256
LIMITS = {
    resource.RLIMIT_AS: MEMORY_BYTES,
    resource.RLIMIT_FSIZE: FILE_BYTES,
    resource.RLIMIT_NOFILE: OPEN_FILES,
    resource.RLIMIT_CORE: 0,
}
LARGEST_ANSWER_BYTES = 64 * 2**20
LONGEST_TEXT = 1000
"""A progress message fits into the pipe in one piece."""
PR_SET_PDEATHSIG = 1


class _State:
    """What `begin` was given."""

    verbs: str
    progress: Connection


def begin(progress: Connection, verbs: str, nice: int) -> None:
    """Initialise the process: end with the service, set the limits, load the verbs."""
    os.dup2(2, 1)  # what a library prints is no line of the service
    logs.configure("worker")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the service, which ends its workers
    # It ends with the fork server, and that one with the service: once nobody but the service holds this pipe.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    os.close(forkserver._forkserver._forkserver_alive_fd)  # pyright: ignore[reportAttributeAccessIssue]
    os.nice(nice)
    for kind, limit in LIMITS.items():
        _limit(kind, limit)
    _State.verbs, _State.progress = verbs, progress
    import_module(verbs)


def _limit(kind: int, limit: int) -> None:
    hard = resource.getrlimit(kind)[1]
    value = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(kind, (value, value))


def limit_processor_time(seconds: float) -> None:
    """Allow this much more processor time; then the process is ended by SIGXCPU."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    soft = int(used.ru_utime + used.ru_stime + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def ready() -> None:
    """Do nothing: awaited as the sign that the process has begun."""


def run(number: int, verb: str, arguments: dict[str, Any], processor_s: float) -> bytes:
    """Do a verb; return its result or its error as JSON."""
    limit_processor_time(processor_s)

    def progress(fraction: float, text: str = "") -> None:
        _State.progress.send_bytes(json.dumps([number, float(fraction), str(text)[:LONGEST_TEXT]]).encode())

    return answer(_State.verbs, verb, progress, arguments)


def answer(verbs: str, verb: str, progress: Any, arguments: dict[str, Any]) -> bytes:
    """Do a verb of a module; return ``{"result": ...}`` or ``{"error": ...}`` as JSON."""
    try:
        result = import_module(verbs).VERBS[verb](progress=progress, **arguments)
        text = json.dumps({"result": result}).encode()
        if len(text) > LARGEST_ANSWER_BYTES:
            raise MemoryError
    except (Exception, SystemExit) as error:  # in the service SystemExit would end the event loop
        text = json.dumps({"error": describe(error)}).encode()
    return text


def describe(error: BaseException) -> dict[str, Any]:
    """Describe an error as the service shows it: an expected one in its own words, others with their type."""
    if isinstance(error, IdentifyError):
        return {"expected": True, "detail": one_line(error), "place": error.place, "fix": error.fix}
    if isinstance(error, MemoryError):
        fix = "Cut the record, or resample it to a lower rate."
        detail = f"it takes more than the {MEMORY_BYTES // 2**20} MB that a worker may have. {fix}"
        return {"expected": True, "detail": detail, "place": None, "fix": fix}
    with contextlib.suppress(MemoryError, RecursionError):
        log.error("a job failed", exc_info=error)
    return {"expected": False, "detail": f"{type(error).__name__}: {one_line(error)}"}


def one_line(error: BaseException) -> str:
    """Return the message of an error without line breaks."""
    return " ".join(str(error).split())
