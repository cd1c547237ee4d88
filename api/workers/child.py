"""A worker process: one call at a time from standard input, one JSON object a line each way.

``{"call": 1, "verb": "fit", "arguments": {…}}`` in; ``progress``, then ``result`` or ``error`` out.
It ends with who started it, also in the middle of a call; a cancelled call's worker is killed. Before the first
call it shuts itself in (`api.workers.confinement`): what it reads, others may have made. ``--reads`` and ``--writes``
name the folders that stay open.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import select
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO

from stimrig.api import logs
from stimrig.api.workers import confinement
from stimrig.identify.errors import IdentifyError

log = logging.getLogger("stimrig.worker")
PROCESSOR_S = 900.0
"""Of processor time for a call that names no other bound."""
VERBS = "stimrig.api.jobs.verbs"


def main() -> None:
    """Serve calls until the input closes, or nobody calls for long."""
    logs.configure("worker")
    confinement.end_with_parent()
    out = own_output()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in `api.cli`: small matrices gain nothing from a second
    options = parsed()
    os.nice(options.nice)
    say(out, {"ready": True, "left_open": shut_in(options)})
    while called_within(options.idle_s) and (line := sys.stdin.readline()):
        request = json.loads(line)
        confinement.limit_time(request.get("processor_s", PROCESSOR_S))
        say(out, {"call": request["call"], **run(request, out, options.verbs)})


def called_within(idle_s: float | None) -> bool:
    """Whether to wait for the next line: always, unless there is a bound.

    With one, a call must come after the answer on the one before: of two that came together the second is read already.
    """
    return idle_s is None or bool(select.select([sys.stdin], [], [], idle_s)[0])


def own_output() -> TextIO:
    """Standard output for the protocol alone: whatever a library prints must not fall into it."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return out


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="stimrig.api.workers.child")
    parser.add_argument("--reads", type=Path, action="append", default=[])
    parser.add_argument("--writes", type=Path, action="append", default=[])
    parser.add_argument("--verbs", default=VERBS, help="module with a table of what can be called")
    parser.add_argument("--memory", type=int, help="bytes beyond what the verbs' libraries take, loaded first")
    parser.add_argument("--nice", type=int, default=5, help="the rig's sender goes first")
    parser.add_argument("--idle-s", type=float, help="end after so long without a call")
    return parser.parse_args()


def shut_in(options: argparse.Namespace) -> dict[str, str]:
    """Leave open only what the command line names; what could not be shut."""
    memory_bytes = confinement.MEMORY_BYTES
    if options.memory is not None:
        import_module(options.verbs).load()
        memory_bytes = options.memory + (confinement.taken() or (memory_bytes, 0))[0]
    return confinement.confine(options.reads, options.writes, memory_bytes)


def run(request: dict[str, Any], out: TextIO, verbs: str = VERBS) -> dict[str, Any]:
    """Do one call; its result or its error as an object."""

    def progress(fraction: float, text: str = "") -> None:
        say(out, {"call": request["call"], "progress": float(fraction), "text": str(text)})

    try:
        verb = import_module(verbs).VERBS[request["verb"]]
        return {"result": verb(progress=progress, **request["arguments"])}
    except Exception as error:
        return {"error": describe(error)}


def describe(error: Exception) -> dict[str, Any]:
    """An error as the service shows it: expected ones in their own words, others by name."""
    if isinstance(error, IdentifyError):
        return {"expected": True, "detail": one_line(error), "place": error.place, "fix": error.fix}
    if isinstance(error, MemoryError):
        megabytes = confinement.MEMORY_BYTES // 2**20
        fix = "Cut the record, or resample it to a lower rate."
        detail = f"it takes more than the {megabytes} MB that a worker may have. {fix}"
        return {"expected": True, "detail": detail, "place": None, "fix": fix}
    log.error("a call failed", exc_info=error)
    return {"expected": False, "detail": f"{type(error).__name__}: {one_line(error)}"}


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def say(out: TextIO, message: dict[str, Any]) -> None:
    out.write(json.dumps(message, allow_nan=True) + "\n")
    out.flush()


if __name__ == "__main__":
    try:
        main()
    except BrokenPipeError:  # the service has ended: nobody listens any more
        os._exit(0)
