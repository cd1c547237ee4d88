"""A worker process: one job at a time from standard input, one JSON object a line each way.

``{"job": 1, "verb": "fit", "arguments": {…}}`` in; ``progress``, then ``result`` or ``error`` out.
It ends when its input closes, so it never outlives the service; a cancelled job's worker is killed.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any, TextIO


def main() -> None:
    """Serve jobs until the input closes."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # whatever a library prints must not fall into the protocol
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in `api.cli`: small matrices gain nothing from a second
    os.nice(5)  # the rig's sender goes first
    say(out, {"ready": True})
    for line in sys.stdin:
        request = json.loads(line)
        say(out, {"job": request["job"], **run(request, out)})


def run(request: dict[str, Any], out: TextIO) -> dict[str, Any]:
    """Do one job; its result or its error as an object."""
    from api import jobs

    def progress(fraction: float, text: str = "") -> None:
        say(out, {"job": request["job"], "progress": float(fraction), "text": str(text)})

    try:
        return {"result": jobs.VERBS[request["verb"]](progress=progress, **request["arguments"])}
    except Exception as error:
        return {"error": describe(error)}


def describe(error: Exception) -> dict[str, Any]:
    """An error as the service shows it: expected ones in their own words, others by name."""
    import traceback

    if any(kind.__name__ == "IdentifyError" for kind in type(error).__mro__):
        place, mend = getattr(error, "place", None), getattr(error, "mend", None)
        return {"expected": True, "detail": one_line(error), "place": text_or_none(place), "mend": text_or_none(mend)}
    traceback.print_exc(file=sys.stderr)
    return {"expected": False, "detail": f"{type(error).__name__}: {one_line(error)}"}


def text_or_none(value: Any) -> str | None:
    """A value as text, None left alone."""
    return None if value is None else str(value)


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
