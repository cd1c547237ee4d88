"""The table of results: one row for each record, each column with its unit and meaning in its field's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.record import Row, failed
from stimrig.api.cohort.select import FIELDS, LABELS

FORMAT = "stimrig-cohort 1"
ERRORS_NM = ("rms_before_nm", "rms_after_nm", "held_out_rms_before_nm", "held_out_rms_after_nm")
OF_STEP = ("fit_percent", "rms_nm", "held_out_fit_percent", "held_out_rms_nm")
TEXTS = pa.list_(pa.string())
EFFECT = pa.struct({
    "effect": pa.string(), "form": pa.string(), "probability": pa.float64(),
    **dict.fromkeys(ERRORS_NM, pa.float64()), "confused_with": TEXTS,
})  # fmt: skip
PARAMETER = pa.struct({
    "of": pa.string(), "name": pa.string(), "value": pa.float64(), "sd": pa.float64(), "unit": pa.string(),
})  # fmt: skip
STEP = pa.struct({"added": pa.string(), **dict.fromkeys(OF_STEP, pa.float64())})
REFUSED = pa.struct({"effect": pa.string(), "log_evidence_gain": pa.float64()})
INSTANT = pa.timestamp("us", tz="UTC")

TYPES: dict[str, pa.DataType] = {
    "text": pa.string(), "day": pa.date32(), "number": pa.float64(), "bytes": pa.int64(),
}  # fmt: skip


def _fields(*names: str) -> Iterator[tuple[str, pa.DataType, str, str]]:
    """Columns that a selection may name, too."""
    for name, field in ((name, FIELDS[name]) for name in names):
        yield name, TYPES.get(name, TYPES[field.type]), field.unit, field.description


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
    ("worker_memory_mb", pa.float64(), "MB", "largest memory of the process that computed, so far"),
    ("status", pa.string(), "", "ok, error, or copy: of the content of another row that is ok"),
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
"""Name, type, unit and meaning."""

SCHEMA = pa.schema([
    pa.field(name, kind, metadata={"unit": unit, "description": description})
    for name, kind, unit, description in COLUMNS
])  # fmt: skip
KEYS = ("address", "stamp", "sha256", "bytes", "verb", "software", "computed_utc")
"""Columns of which record a row is, and how it was made; none is the record's own."""
BATCH_ROWS = 1000
"""Rows held in memory while tables are read."""


def rows_to_table(rows: Sequence[Row]) -> pa.Table:
    """Make a table of rows; keys that are no column are dropped. A row that cannot be stored becomes an error."""
    try:
        return pa.Table.from_pylist(list(rows), SCHEMA)
    except (pa.ArrowException, OverflowError, TypeError, ValueError) as error:
        if len(rows) > 1:
            return pa.concat_tables(rows_to_table([row]) for row in rows)
        keys = {name: rows[0].get(name) for name in KEYS}
        return pa.Table.from_pylist([keys | failed("unexpected", f"its row cannot be stored ({error})")], SCHEMA)


def read_rows(file: Path, columns: Sequence[str] = ()) -> Iterator[Row]:
    """Read these or all columns of a table, some rows at a time. Raises CohortError: it is damaged."""
    try:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(BATCH_ROWS, columns=list(columns) or None):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise CohortError(f"{file}: cannot be read ({' '.join(str(error).split())[:200]}).") from None


def read_options(file: Path) -> dict[str, Any]:
    """Return the options of the run that made a table. Raises CohortError: it is no table of results."""
    try:
        schema = pq.read_schema(file)
        about = schema.metadata or {}
        if about[b"format"] != FORMAT.encode() or not schema.equals(SCHEMA):
            raise ValueError
        return dict(json.loads(about[b"options"]))
    except (pa.ArrowException, OSError, KeyError, ValueError, TypeError, RecursionError):
        raise CohortError(f"{file}: no results of `stimrig cohort` of this version. Give another -o.") from None
