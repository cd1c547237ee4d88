"""A job as the worker process does it: one verb, its progress, its result or error as JSON."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable
from importlib import import_module
from typing import Any

from stimrig.api import logs
from stimrig.api.jobs.process import report
from stimrig.identify.errors import IdentifyError

log = logging.getLogger("stimrig.worker")
MEMORY_BYTES = 3 * 2**29
"""Twice what the largest record takes."""
LARGEST_ANSWER_BYTES = 64 * 2**20
LONGEST_TEXT = 1000
"""A progress message fits into the pipe in one piece."""


def run(number: int, verbs: str, verb: str, arguments: dict[str, Any]) -> bytes:
    """Do the job with this number; report its progress through the pipe."""
    logs.configure("worker")

    def progress(fraction: float, text: str = "") -> None:
        report(json.dumps([number, float(fraction), str(text)[:LONGEST_TEXT]]).encode())

    return answer(verbs, verb, progress, arguments)


def answer(verbs: str, verb: str, progress: Callable[..., None], arguments: dict[str, Any]) -> bytes:
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
    """Return what an `ApiError` is made of: an expected error in its own words, others with their type."""
    words = " ".join(str(error).split())
    data = {"status": 422, "code": "data", "title": "The data do not allow this"}
    if isinstance(error, IdentifyError):
        more = {"place": error.place, "fix": error.fix}
        return {**data, "detail": words, **{key: value for key, value in more.items() if value}}
    if isinstance(error, MemoryError):
        fix = "Cut the record, or resample it to a lower rate."
        return {**data, "detail": f"it takes more than {MEMORY_BYTES // 2**20} MB of memory. {fix}", "fix": fix}
    with contextlib.suppress(MemoryError, RecursionError):
        log.error("a job failed", exc_info=error)
    detail = f"{type(error).__name__}: {words}. Your data are safe. See logs/api.log."
    return {"status": 500, "code": "analysis-failed", "title": "The analysis failed", "detail": detail}
