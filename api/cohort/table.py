"""The table of results: one row a record, each column with its unit and what it says (needs pyarrow).

It is read for the options it was made with, its rows, and which rows of many parts count.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from stimrig.api.cohort.computing import COPY, LEFT_OUT, digest
from stimrig.api.cohort.record import OF_EFFECT, OF_STEP
from stimrig.api.cohort.select import FIELDS, LABELS
from stimrig.api.cohort.tasks import CohortError

FORMAT = "stimrig-cohort"
FORMAT_VERSION = "1"
TEXTS = pa.list_(pa.string())
EFFECT = pa.struct(
    [
        ("effect", pa.string()),
        ("form", pa.string()),
        *((name, pa.float64()) for name in OF_EFFECT),
        ("confused_with", TEXTS),
    ]
)
PARAMETER = pa.struct(
    [("of", pa.string()), ("name", pa.string()), ("value", pa.float64()), ("sd", pa.float64()), ("unit", pa.string())]
)
STEP = pa.struct([("added", pa.string()), *((name, pa.float64()) for name in OF_STEP)])
REFUSED = pa.struct([("effect", pa.string()), ("log_evidence_gain", pa.float64())])
INSTANT = pa.timestamp("us", tz="UTC")

TYPES: dict[str, pa.DataType] = {
    "text": pa.string(), "day": pa.date32(), "number": pa.float64(), "bytes": pa.int64(),
}  # fmt: skip


def _fields(*names: str) -> Iterator[tuple[str, pa.DataType, str, str]]:
    """Columns that a selection may name, too."""
    for name, field in ((name, FIELDS[name]) for name in names):
        yield name, TYPES.get(name, TYPES[field.type]), field.unit, field.says


COLUMNS: tuple[tuple[str, pa.DataType, str, str], ...] = (
    *_fields("record_id"),
    ("address", pa.string(), "", "where it was read"),
    *_fields("name", "origin"),
    ("sha256", pa.string(), "", "SHA-256 of the file; null where it could not be read"),
    ("stamp", pa.string(), "", "state of the file when it was listed: it changes with the content"),
    *_fields("bytes", "participant", "day"),
    ("begun_utc", INSTANT, "", "when the recording was made"),
    *_fields(*LABELS, "test_id", "outcome"),
    ("recorded_by", pa.string(), "", "software that sealed the recording"),
    *_fields("duration_s", "rate_hz"),
    ("verb", pa.string(), "", "fit, diagnose or improve"),
    ("software", pa.string(), "", "version of stimrig that computed the row"),
    ("computed_utc", INSTANT, "", "when the row came"),
    ("took_s", pa.float64(), "s", "time to read and compute"),
    ("processor_s", pa.float64(), "s", "processor time of it"),
    ("worker_memory_mb", pa.float64(), "MB", "memory of the process that computed, after this record"),
    ("status", pa.string(), "", "ok or error"),
    ("error_kind", pa.string(), "", "why there is no result, as one word or two"),
    ("error", pa.string(), "", "why there is no result, in one line"),
    ("notes", TEXTS, "", "what was assumed when the record was read"),
    ("verdict", pa.string(), "", "of fit: usable, usable with care, not usable; else the diagnosis"),
    ("probability", pa.float64(), "1", "of the diagnosis"),
    ("fit_percent", pa.float64(), "%", "best fit; of diagnose: the plain structure's; of improve: the last model's"),
    ("ceiling_percent", pa.float64(), "%", "best fit that the noise allows"),
    ("rms_nm", pa.float64(), "N·m", "error on the fitted pulses"),
    ("held_out_fit_percent", pa.float64(), "%", "best fit on held-out pulses"),
    ("held_out_rms_nm", pa.float64(), "N·m", "error on held-out pulses"),
    ("held_out_by", pa.string(), "", "how the held-out values were found"),
    ("noise_sd_nm", pa.float64(), "N·m", "white noise of a sample, standard deviation"),
    ("reasons", TEXTS, "", "reasons of the verdict"),
    ("effects", pa.list_(EFFECT), "", "effects of the model (fit, improve), or those missing (diagnose)"),
    ("parameters", pa.list_(PARAMETER), "", "value, standard deviation and unit of each; `of` is an effect or model"),
    ("next_experiment", pa.string(), "", "the test that would tell the rivals apart, in words"),
    ("next_experiment_s", pa.float64(), "s", "its duration"),
    ("steps", pa.list_(STEP), "", "improve: the models, one effect more each"),
    ("refused", pa.list_(REFUSED), "", "improve: effects that were not added"),
)
"""Name, type, unit and what it says."""

MISFITS = (pa.ArrowException, OverflowError, TypeError, ValueError)


SCHEMA = pa.schema([
    pa.field(name, kind, metadata={"unit": unit, "description": says}) for name, kind, unit, says in COLUMNS
])  # fmt: skip
"""Unit and meaning of a column stand in its field's metadata."""
ROWS_A_GROUP = 5000
ROWS_AT_ONCE = 1000
"""Rows held in memory while tables are read."""
KEYS = ("sha256", "address", "stamp", "bytes", "status", "error_kind")
"""Columns that tell which record a row is of."""


def table_of(rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Make a table of rows; keys that are no column are dropped."""
    arrays = [_array([_cell(row.get(field.name), field.type) for row in rows], field.type) for field in SCHEMA]
    return pa.Table.from_arrays(arrays, schema=SCHEMA)


def _array(values: list[Any], kind: pa.DataType) -> pa.Array:
    """A column; a value that does not fit is null: what a file says must not end a run."""
    try:
        return pa.array(values, kind)
    except MISFITS:
        return pa.concat_arrays([_one(value, kind) for value in values])


def _one(value: Any, kind: pa.DataType) -> pa.Array:
    try:
        return pa.array([value], kind)
    except MISFITS:
        return pa.nulls(1, kind)


def _cell(value: Any, kind: pa.DataType) -> Any:
    """A value as the column holds it; None where a file says nonsense, which must not end a run."""
    if kind == pa.date32() and isinstance(value, str):
        try:
            return date.fromisoformat(value)
        except ValueError:
            return None
    if kind == INSTANT and isinstance(value, str):
        try:
            found = datetime.fromisoformat(value)
            return (found if found.tzinfo else found.replace(tzinfo=UTC)).astimezone(UTC)
        except (ValueError, OverflowError):
            return None
    if kind == pa.string() and isinstance(value, str):
        return value.encode("utf-8", "replace").decode()
    return value


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
    """Rows of a table, some at a time. Raises CohortError: it is damaged, or no such table."""
    try:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(ROWS_AT_ONCE, columns=list(columns)):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise CohortError(f"{file}: cannot be read ({' '.join(str(error).split())[:200]}).") from None


def rows_in(file: Path) -> int:
    return pq.read_metadata(file).num_rows


def groups(files: Sequence[Path], kept: set[int]) -> Iterator[pa.Table]:
    """The rows that are kept, so many at a time."""
    number, waiting = 0, [SCHEMA.empty_table()]
    for file in files:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(ROWS_AT_ONCE):
                rows = [index for index in range(batch.num_rows) if number + index in kept]
                whole = pa.concat_tables(
                    [SCHEMA.empty_table(), pa.Table.from_batches([batch])], promote_options="default"
                )
                waiting.append(whole.select(SCHEMA.names).cast(SCHEMA).take(pa.array(rows, pa.int64())))
                number += batch.num_rows
                if sum(part.num_rows for part in waiting) >= ROWS_A_GROUP:
                    yield pa.concat_tables(waiting)
                    waiting = []
    if waiting:
        yield pa.concat_tables(waiting)


def options_of(file: Path) -> dict[str, Any]:
    """The options that a table of results was made with.

    Raises CohortError: it is no table of results, or there is no such file.
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
        types = dict.fromkeys(LABELS, pa.string()) | types  # a label may be younger than the table
        if odd := [column.name for column in SCHEMA if types.get(column.name) != column.type]:
            raise CohortError(f"{file}: its column {odd[0]} is missing or of another type. {fix}")
        return dict(json.loads(about[b"options"]))
    except (pa.ArrowException, OSError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise CohortError(f"{file}: no table of results ({' '.join(str(error).split())[:120]}). {fix}") from None
