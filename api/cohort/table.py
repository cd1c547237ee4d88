"""The table of results: one row a record, each column with its unit and what it says (needs pyarrow)."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime
from typing import Any

import pyarrow as pa

from api.cohort.answers import OF_EFFECT, OF_STEP

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

COLUMNS: tuple[tuple[str, pa.DataType, str, str], ...] = (
    ("record_id", pa.string(), "", "id of the recording, where it says one"),
    ("address", pa.string(), "", "where it was read"),
    ("name", pa.string(), "", "name of the file, or id at a centre"),
    ("origin", pa.string(), "", "the DATA in which it was found"),
    ("sha256", pa.string(), "", "SHA-256 of the file; null where it could not be read"),
    ("stamp", pa.string(), "", "state of the file when it was listed: it changes with the content"),
    ("bytes", pa.int64(), "B", "size of the file"),
    ("participant", pa.string(), "", "code of the participant"),
    ("day", pa.date32(), "", "day of the session, UTC"),
    ("begun_utc", INSTANT, "", "when the recording was made"),
    ("kind", pa.string(), "", "kind of test"),
    ("rig", pa.string(), "", "id of the rig, where a centre knows it"),
    ("test_id", pa.string(), "", "id of the test"),
    ("outcome", pa.string(), "", "how the test ended: completed, stopped, fault"),
    ("recorded_by", pa.string(), "", "software that sealed the recording"),
    ("duration_s", pa.float64(), "s", "from the first sample to the last"),
    ("rate_hz", pa.float64(), "Hz", "samples a second"),
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
    ("rms_nm", pa.float64(), "N·m", "error on the fitted rows"),
    ("held_out_fit_percent", pa.float64(), "%", "best fit on held-out rows"),
    ("held_out_rms_nm", pa.float64(), "N·m", "error on held-out rows"),
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

SCHEMA = pa.schema(
    [
        pa.field(name, kind, metadata={"description": says, **({"unit": unit} if unit else {})})
        for name, kind, unit, says in COLUMNS
    ]
)


def table_of(rows: Sequence[dict[str, Any]], schema: pa.Schema = SCHEMA) -> pa.Table:
    """Rows as a table; keys that are no column are dropped."""
    arrays = [_array([_cell(row.get(field.name), field.type) for row in rows], field.type) for field in schema]
    return pa.Table.from_arrays(arrays, schema=schema)


def _array(values: list[Any], kind: pa.DataType) -> pa.Array:
    """A column; a value that does not fit is null: what a file or a centre says must not end a run."""
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
