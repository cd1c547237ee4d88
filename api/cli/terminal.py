"""Print a verb's result: `report` for people or as JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

CLEAR_LINE = "\r\x1b[K"


def print_lines(*lines: object) -> None:
    """Print lines for people."""
    print(*lines, sep="\n", flush=True)


def print_aside(words: str) -> None:
    """Print on standard error, on a line of its own: standard output is the result's."""
    print(f"{CLEAR_LINE}{words}" if sys.stderr.isatty() else words, file=sys.stderr, flush=True)


def report(document: Mapping[str, Any], as_json: bool, *lines: object, files: Iterable[Path | None] = ()) -> None:
    """Print one JSON object and nothing else; or lines for people, and which `files` were written."""
    if as_json:
        from stimrig.identify.json_text import json_value

        print(json.dumps(json_value(document), ensure_ascii=False, allow_nan=False))
    else:
        print_lines(*lines, *(f"written to {path}" for path in files if path is not None))


def listed(document: Mapping[str, Any]) -> list[str]:
    """Write keys and values below one another."""
    return [f"{key.replace('_', ' '):12} {value}" for key, value in document.items()]
