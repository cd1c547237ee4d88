"""Logs as one JSON object a line on standard error."""

from __future__ import annotations

import json
import logging
import sys
from contextvars import ContextVar

current_test: ContextVar[str | None] = ContextVar("test_id", default=None)
"""The test that is being dealt with: every line that comes of it carries its id, whoever writes the line."""


class JsonLines(logging.Formatter):
    """One object a line: time, level, logger, message, and the test's id where there is one."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        test_id = getattr(record, "test_id", None) or current_test.get()
        if test_id is not None:
            line["test_id"] = test_id
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def configure(level: int = logging.INFO) -> None:
    """Send every logger's lines to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    logging.basicConfig(level=level, handlers=[handler], force=True)
