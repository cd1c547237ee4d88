"""Tables of results read: which options they were made with, their rows, and which rows of many parts count."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from api.cohort.errors import CohortError
from api.cohort.table import FORMAT, FORMAT_VERSION, SCHEMA
from api.cohort.worker import COPY, LEFT_OUT, digest

ROWS_A_GROUP = 5000
ROWS_AT_ONCE = 1000
"""Rows held in memory while tables are read."""
KEYS = ("sha256", "address", "stamp", "bytes", "status", "error_kind")
"""Columns that tell which record a row is of."""


def kept_rows(files: Sequence[Path]) -> tuple[set[int], dict[str, int]]:
    """Numbers of the rows to hand out: the last one of each content and of each place; and how many are what.

    A file that was replaced by another takes its old row with it, unless the old content lies elsewhere, too.
    """
    by_content: dict[bytes, int] = {}
    by_place: dict[bytes, int] = {}
    statuses: dict[int, str] = {}
    replaced: dict[int, str] = {}
    failed: dict[int, bytes] = {}
    copies: dict[bytes, bytes] = {}
    for number, row in enumerate(row for file in files for row in rows_of(file, KEYS)):
        place = digest(row["address"])
        if row["status"] == COPY:
            copies[place] = digest(row["sha256"])
        elif row["status"] != LEFT_OUT:
            content = digest(row["sha256"]) if row["status"] == "ok" else place
            statuses.pop(by_content.get(content, -1), None)
            if (old := by_place.get(place, -1)) in statuses:
                replaced[old] = statuses.pop(old)
            by_content[content] = by_place[place] = number
            if row["status"] == "error" and row["sha256"]:
                failed[number] = digest(row["sha256"])
            statuses[number] = row["status"]
    lying = {by_content.get(content, -1) for content in copies.values()}
    statuses |= {number: status for number, status in replaced.items() if number in lying}
    for number, content in failed.items():
        if statuses.get(by_content.get(content, -1)) == "ok":  # done elsewhere since
            statuses.pop(number, None)
    counts = {word: sum(1 for status in statuses.values() if status == word) for word in ("ok", "error")}
    return set(statuses), {**counts, "copies": len(copies)}


def rows_of(file: Path, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of a table, some at a time.

    Raises
    ------
    CohortError
        It is damaged, or no such table.
    """
    try:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(ROWS_AT_ONCE, columns=list(columns)):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise CohortError(f"{file}: cannot be read ({' '.join(str(error).split())[:200]}).") from None


def rows_in(file: Path) -> int:
    """How many rows a table has."""
    return pq.read_metadata(file).num_rows


def groups(files: Sequence[Path], kept: set[int]) -> Iterator[pa.Table]:
    """The rows that are kept, so many at a time."""
    number, waiting = 0, [SCHEMA.empty_table()]
    for file in files:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(ROWS_AT_ONCE):
                rows = [index for index in range(batch.num_rows) if number + index in kept]
                waiting.append(
                    pa.Table.from_batches([batch]).select(SCHEMA.names).cast(SCHEMA).take(pa.array(rows, pa.int64()))
                )
                number += batch.num_rows
                if sum(part.num_rows for part in waiting) >= ROWS_A_GROUP:
                    yield pa.concat_tables(waiting)
                    waiting = []
    if waiting:
        yield pa.concat_tables(waiting)


def options_of(file: Path) -> dict[str, Any]:
    """The options that a table of results was made with.

    Raises
    ------
    CohortError
        It is no table of results, or there is no such file.
    """
    if not file.exists():
        raise CohortError(f"{file}: no such file. Give the -o of `stimrig cohort fit`, `diagnose` or `improve`.")
    fix = "Give a file written by `stimrig cohort fit`, `diagnose` or `improve`."
    try:
        schema = pq.read_schema(file)
        about = schema.metadata or {}
        if about.get(b"format") != FORMAT.encode():
            raise CohortError(f"{file}: Parquet, but no results of a cohort. {fix}")
        if about.get(b"format_version") != FORMAT_VERSION.encode():
            raise CohortError(f"{file}: format version {about.get(b'format_version', b'?').decode()}. Update stimrig.")
        types = dict(zip(schema.names, schema.types, strict=True))
        if odd := [column.name for column in SCHEMA if types.get(column.name) != column.type]:
            raise CohortError(f"{file}: its column {odd[0]} is missing or of another type. {fix}")
        return dict(json.loads(about[b"options"]))
    except (pa.ArrowException, OSError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise CohortError(f"{file}: no table of results ({' '.join(str(error).split())[:120]}). {fix}") from None
