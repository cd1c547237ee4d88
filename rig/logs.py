"""Logs of the rig's processes: one JSON object a line on standard error, fields as docs/operation.md lists them."""

from __future__ import annotations

import json
import logging
import sys
import threading


class JsonLines(logging.Formatter):
    """One JSON object per line, with the test's id if there is one. `process`: which one writes it."""

    def __init__(self, process: str) -> None:
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
        if (test_id := getattr(record, "test_id", None)) is not None:
            line["test_id"] = test_id
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def configure(process: str, level: int = logging.INFO) -> None:
    """Send every logger's lines to standard error, also warnings, and the error that ends a process or a thread."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines(process))
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    log = logging.getLogger("rig")
    sys.excepthook = lambda kind, error, trace: log.critical("ended by an error", exc_info=(kind, error, trace))
    threading.excepthook = lambda failure: log.critical("a thread ended by an error", exc_info=failure.exc_value)
