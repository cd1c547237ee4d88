"""Print results for people, or as JSON."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable
from typing import Any

CLEAR_LINE = "\r\x1b[K"


def say(*lines: str) -> None:
    """Print lines for people."""
    print("\n".join(lines))


def say_aside(words: str) -> None:
    """Print on standard error, on a line of its own: standard output is the result's."""
    print(f"{CLEAR_LINE}{words}" if sys.stderr.isatty() else words, file=sys.stderr, flush=True)


def say_json(document: dict[str, Any]) -> None:
    """Print one JSON object, nothing else."""
    from stimrig.identify.json_text import json_value

    print(json.dumps(json_value(document), ensure_ascii=False, allow_nan=False))


def number(value: float | None, digits: int = 2) -> str:
    """Write a number for people; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """Write a best-fit % for people; why there is none."""
    from stimrig.api.models.stored_model import UNDEFINED

    return UNDEFINED if value is None or not math.isfinite(value) else f"{value:.2f} %"


def labelled(label: str, texts: Iterable[str]) -> list[str]:
    """Write texts below one another, the first behind a label."""
    return [f"{'' if row else label:15}{text}" for row, text in enumerate(texts)]


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Write columns, aligned."""
    cells = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[index]) for row in cells) for index in range(len(cells[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]
