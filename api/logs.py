"""Logs as one JSON object a line on standard error; docs/operation.md lists the fields. No line names a person."""

from __future__ import annotations

import json
import logging
import sys
import threading
from contextvars import ContextVar

log = logging.getLogger("stimrig")
current_test: ContextVar[str | None] = ContextVar("test_id", default=None)
"""Id of the current test, added to every log line written on its behalf."""
current_request: ContextVar[str | None] = ContextVar("request_id", default=None)
"""The HTTP request that is being answered, and what it started in the background; the middleware draws the id."""


class JsonLines(logging.Formatter):
    """One object a line: time, level, process, logger, message; the ids of test and request where known.

    `process`: which one writes it.
    """

    def __init__(self, process: str = "service") -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": record.getMessage(),
        }
        test_id = getattr(record, "test_id", None) or current_test.get()
        if test_id is not None:
            line["test_id"] = test_id
        if (request_id := current_request.get()) is not None:
            line["request_id"] = request_id
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def configure(process: str = "service") -> None:
    """Send every logger's lines to standard error; also warnings, and the error that ends a process or a thread."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines(process))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.captureWarnings(True)
    sys.excepthook = lambda kind, error, trace: log.critical("ended by an error", exc_info=(kind, error, trace))
    threading.excepthook = lambda args: log.critical("a thread ended by an error", exc_info=args.exc_value)
