"""A worker process: one call at a time from standard input, one JSON object a line each way.

``{"call": 1, "verb": "fit", "arguments": {…}}`` in; ``progress``, then ``result`` or ``error`` out.
It ends with the service, also in the middle of a call; a cancelled call's worker is killed. Before the first
call it shuts itself in (`api.workers.confinement`): what it reads, others may have made. ``--reads`` and ``--writes``
name the folders that stay open.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any, TextIO

from stimrig.api.workers import confinement
from stimrig.identify.errors import IdentifyError

PROCESSOR_S = 900.0
"""Of processor time for a call that names no other bound."""


def main() -> None:
    """Serve calls until the input closes."""
    confinement.end_with_parent()
    out = own_output()
    os.environ.setdefault(
        "OPENBLAS_NUM_THREADS", "1"
    )  # as in `stimrig.api.cli`: small matrices gain nothing from a second
    os.nice(5)  # the rig's sender goes first
    say(out, {"ready": True, "left_open": shut_in()})
    for line in sys.stdin:
        request = json.loads(line)
        confinement.limit_time(request.get("processor_s", PROCESSOR_S))
        say(out, {"call": request["call"], **run(request, out)})


def own_output() -> TextIO:
    """Standard output for the protocol alone: whatever a library prints must not fall into it."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return out


def shut_in() -> dict[str, str]:
    """Leave open only what the command line names; what could not be shut."""
    parser = argparse.ArgumentParser(prog="stimrig.api.workers.child")
    parser.add_argument("--reads", type=Path, action="append", default=[])
    parser.add_argument("--writes", type=Path, action="append", default=[])
    options = parser.parse_args()
    return confinement.confine(options.reads, options.writes)


def run(request: dict[str, Any], out: TextIO) -> dict[str, Any]:
    """Do one call; its result or its error as an object."""
    from stimrig.api.workers import verbs

    def progress(fraction: float, text: str = "") -> None:
        say(out, {"call": request["call"], "progress": float(fraction), "text": str(text)})

    try:
        return {"result": verbs.VERBS[request["verb"]](progress=progress, **request["arguments"])}
    except Exception as error:
        return {"error": describe(error)}


def describe(error: Exception) -> dict[str, Any]:
    """An error as the service shows it: expected ones in their own words, others by name."""
    import traceback

    if isinstance(error, IdentifyError):
        return {"expected": True, "detail": one_line(error), "place": error.place, "fix": error.fix}
    if isinstance(error, MemoryError):
        megabytes = confinement.MEMORY_BYTES // 2**20
        fix = "Cut the record, or resample it to a lower rate."
        detail = f"it takes more than the {megabytes} MB that a worker may have. {fix}"
        return {"expected": True, "detail": detail, "place": None, "fix": fix}
    traceback.print_exc(file=sys.stderr)
    return {"expected": False, "detail": f"{type(error).__name__}: {one_line(error)}"}


def one_line(error: Exception) -> str:
    """An error's message on one line."""
    return " ".join(str(error).split())


def say(out: TextIO, message: dict[str, Any]) -> None:
    """One object, one line."""
    out.write(json.dumps(message, allow_nan=True) + "\n")
    out.flush()


if __name__ == "__main__":
    try:
        main()
    except BrokenPipeError:  # the service has ended: nobody listens any more
        os._exit(0)
