"""Parquet: `samples/` and `pulses/` as partitioned datasets, `records.parquet` with one row a record, a dictionary."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stimrig.api.cohort.export import Put, Who
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.select import FIELDS, LABELS
from stimrig.api.cohort.table import TYPES, schema_of, table_of
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.identify.records.cells import lines
from stimrig.identify.records.record import HELD_OUT

Kind = Literal["text", "number", "integer", "true or false", "time"]


class Column(NamedTuple):
    name: str
    type: Kind
    unit: str
    meaning: str
    range: str
    source: str


WHO = (
    ("record_id", "text", "", "id of the recording; of a table its first 16 digits of the SHA-256", "", "recording_id"),
    ("participant", "text", "", "code of the participant, as it was given", "", "participant"),
    ("session", "text", "", "session: the day of the recording (UTC), or the label in its place", "", "created_utc"),
)
COLUMNS = {table: [Column(*entry) for entry in entries] for table, entries in {
    "samples": (
        *WHO,
        ("time_s", "number", "s", "time of the sample on the test's clock; 0 is the start of the first segment",
         "rising", "/torque/time_s"),
        ("torque_nm", "number", "N·m", "elbow torque at the cell's rate, zero not removed", "", "/torque/torque_nm"),
        ("pulse_width_us", "number", "µs", "width of the pulse in force, held between pulses; 0: none; null: outside "
         "of every segment", "0 to 1000", "computed: the last pulse due before the sample that was sent"),
        ("segment", "text", "", "name of the segment; null: outside of every segment", "rest, prbs, ramp, validate, or "
         "the user's own", "/segments"),
        ("segment_index", "integer", "1", "index of the segment, from 0", "from 0", "/segments"),
        ("held_out", "true or false", "", "whether the segment is `validate`: never used to fit", "", "/segments"),
        ("late_s", "number", "s", "by how much later than its even slot the pulse in force was felt", "-1 to 1",
         "computed: sync line, or written and acknowledged times"),
        ("doubted", "true or false", "", "whether it is not known what was felt", "", "computed"),
        ("angle_rad", "number", "rad", "joint angle, where the record has it", "", "column of a table"),
        ("velocity_rad_s", "number", "rad/s", "angular velocity, where the record has it", "", "column of a table"),
        ("counter", "integer", "1", "the cell's counter, unwrapped; null: it has none", "from 0", "/torque/counter"),
        ("host_time_s", "number", "s", "when the host received the sample, test's clock", "", "/torque/host_time_s"),
        ("sync", "integer", "1", "the stimulator's sync line as the cell saw it; null: there is none", "0 or 1",
         "/torque/sync"),
        ("part", "integer", "1", "which part of a joined record, from 0", "from 0", "column part of a joined table"),
    ),
    "pulses": (
        *WHO,
        ("index", "integer", "1", "index of the pulse in the test, from 0", "from 0", "row of /pulses"),
        ("planned_time_s", "number", "s", "when the pulse was due, test's clock", "from 0", "/pulses/planned_time_s"),
        ("pulse_width_us", "number", "µs", "planned width of a phase; 0: none", "0 to 1000", "/pulses/pulse_width_us"),
        ("sent_pulse_width_us", "number", "µs", "what was sent after rounding; null: nothing was sent", "0 to 1000",
         "/pulses/sent_pulse_width_us"),
        ("current_ma", "number", "mA", "current sent; 0 where nothing was sent", "from 0", "/pulses/current_ma"),
        ("written_time_s", "number", "s", "when the command had been written to the line; null: it was not", "",
         "/pulses/written_time_s"),
        ("acknowledged_time_s", "number", "s", "when the device's acknowledgement was read; null: none came", "",
         "/pulses/acknowledged_time_s"),
        ("status", "text", "", "what became of the pulse", "acknowledged, rest, dropped, refused, unacknowledged, "
         "device error", "/pulses/status"),
        ("segment", "text", "", "name of the segment it was due in", "", "/segments"),
    ),
    "records": (
        *WHO,
        ("sha256", "text", "", "SHA-256 of the file that was exported", "64 digits", "computed"),
        ("content_sha256", "text", "", "the recording's own hash over its datasets", "64 digits", "content_sha256"),
        ("format", "text", "", "what the file was", "sealed recording, table", "computed"),
        ("address", "text", "", "where it was read; null where days are hidden", "", "DATA"),
        ("test_id", "text", "", FIELDS["test_id"].says, "", "test_id"),
        *((name, "text", "", label.says, "", name) for name, label in LABELS.items()),
        ("begun_utc", "time", "", "when the recording was made (UTC); moved or null where days are hidden", "",
         "created_utc"),
        ("outcome", "text", "", "how the test ended", "completed, stopped, fault", "outcome"),
        ("reason", "text", "", "why it ended early; null where days are hidden", "", "reason"),
        ("ended_by", "text", "", "what ended it", "", "ended_by"),
        ("recorded_by", "text", "", "software that sealed the recording", "", "software"),
        ("duration_s", "number", "s", "from the first sample in a segment to the last", "from 0", "computed"),
        ("sample_rate_hz", "number", "Hz", "samples a second, gaps aside", "above 0", "computed from time_s"),
        ("pulse_rate_hz", "number", "Hz", "pulses a second", "above 0", "pulse_rate_hz"),
        ("current_ma", "number", "mA", "current of the test", "from 0", "current_ma"),
        ("samples", "integer", "1", "number of torque samples", "from 1", "computed"),
        ("pulses", "integer", "1", "number of planned pulses; 0 where no list of them is known", "from 0", "computed"),
        ("alignment_method", "text", "", "how torque and pulses came to one clock", "sync, regression", "/alignment"),
        ("alignment_error_ms", "number", "ms", "standard error of that", "from 0", "/alignment"),
        ("alignment_delay_ms", "number", "ms", "median time from a sample to its arrival", "", "/alignment"),
        ("alignment_rate_ppm", "number", "1e-6", "how much slower the cell's clock ran", "", "/alignment"),
        ("segments", "text", "", "JSON: name, start and end (s) of each segment, end exclusive", "", "/segments"),
        ("settings", "text", "", "JSON: the plan as it was asked for; null where days are hidden", "", "configuration"),
        ("notes", "text", "", "what was assumed when it was read, one sentence a line", "", "computed"),
    ),
}.items()}  # fmt: skip


SCHEMAS = {table: schema_of((c.name, TYPES[c.type], c.unit, c.meaning) for c in columns)
           for table, columns in COLUMNS.items()}  # fmt: skip


def as_json(title: str) -> str:
    """The dictionary for programs."""
    tables = {
        table: {name: dict(zip(Column._fields[1:], said, strict=True)) for name, *said in columns}
        for table, columns in COLUMNS.items()
    }
    return json.dumps({"title": title, "tables": tables}, ensure_ascii=False, indent=2) + "\n"


def as_csv() -> str:
    """The dictionary as a table, for a spreadsheet."""
    rows = ((table, *column) for table, columns in COLUMNS.items() for column in columns)
    return "".join(lines([("table", *Column._fields), *rows]))


NAME: str = "parquet"
STATUS = ("acknowledged", "rest", "dropped", "refused", "unacknowledged", "device error")
ROWS = 2000
"""Rows of `records.parquet` that are held in memory at once."""
KEPT_NAN = ("time_s", "torque_nm")


def write(record: WholeRecord, who: Who, put: Put) -> dict[str, Any]:
    """The record's samples and pulses; its row of `records`."""
    place = f"sub={who.label}/ses={who.session}/{who.key}.parquet"
    with put(f"samples/{place}") as file:
        pq.write_table(samples(record, who), file, compression="zstd")
    with put(f"pulses/{place}") as file:
        pq.write_table(pulses(record, who), file, compression="zstd")
    return record_row(record, who)


def finish(state: State, put: Put) -> None:
    """`records.parquet` and the dictionary."""
    schema = SCHEMAS["records"]
    with put("records.parquet") as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        rows = (row for _, _, row in state.rows())
        while batch := list(islice(rows, ROWS)):
            writer.write_table(table_of(batch, schema))
    for name, text in (
        ("data_dictionary.json", as_json("stimrig export, Parquet")),
        ("data_dictionary.csv", as_csv()),
    ):
        with put(name) as file:
            file.write(text.encode())


def samples(record: WholeRecord, who: Who) -> pa.Table:
    columns, size = record.samples, len(record.samples["time_s"])
    index = columns["segment"].astype(int)
    names = record.about["segment_names"]
    made: dict[str, Any] = {
        **_who(who, size),
        "segment": _texts(index, names),
        "segment_index": pa.array(index, pa.int64(), mask=index < 0),
        "held_out": pa.array(np.isin(index, [i for i, name in enumerate(names) if name == HELD_OUT])),
    }
    return _table("samples", made, columns, size)


def pulses(record: WholeRecord, who: Who) -> pa.Table:
    """The table of a record's pulses; empty where it has no list of them."""
    columns = record.pulses
    size = len(next(iter(columns.values()), []))
    made: dict[str, Any] = {**_who(who, size), "index": pa.array(np.arange(size), pa.int64())}
    status = columns.get("status", np.full(size, -1.0))
    status = np.where(np.isin(status, range(len(STATUS))), status, -1).astype(int)
    made["status"] = _texts(status, STATUS)
    planned_s = columns.get("planned_time_s", np.empty(0))
    made["segment"] = _texts(segment_at(record, planned_s), [name for name, _, _ in record.segments])
    return _table("pulses", made, columns, size)


def segment_at(record: WholeRecord, time_s: np.ndarray) -> np.ndarray:
    """Index of the segment that each time lies in; −1: none."""
    starts = np.array([start for _, start, _ in record.segments])
    ends = np.array([end for _, _, end in record.segments])
    if not len(starts):
        return np.full(len(time_s), -1)
    found = np.searchsorted(starts, time_s + 1e-9, side="right") - 1
    inside = (found >= 0) & (time_s < ends[np.maximum(found, 0)] - 1e-9)
    return np.where(inside, found, -1)


def record_row(record: WholeRecord, who: Who) -> dict[str, Any]:
    about = record.about
    plan = _plan(about.get("configuration"))
    row = {column.name: about.get(column.name) for column in COLUMNS["records"]}
    return row | {
        "record_id": who.record_id,
        "participant": who.participant,
        "session": who.session,
        "sha256": record.sha256,
        "begun_utc": who.begun_utc,
        "sample_rate_hz": record.sample_rate_hz,
        "samples": len(record.samples["time_s"]),
        "pulses": len(next(iter(record.pulses.values()), [])),
        "segments": json.dumps([dict(zip(("name", "start_s", "end_s"), s, strict=True)) for s in record.segments]),
        "settings": None if plan is None else json.dumps(plan, ensure_ascii=False),
        "notes": "\n".join(record.notes),
    }


def _plan(configuration: str | None) -> Any:
    """The plan as it was asked for; None where a file says nothing of it, or nonsense."""
    try:
        found = json.loads(configuration or "{}")
    except (ValueError, RecursionError):
        return None
    return found.get("plan") if isinstance(found, dict) else None


def _who(who: Who, size: int) -> dict[str, Any]:
    named = {"record_id": who.record_id, "participant": who.participant, "session": who.session}
    return {name: pa.repeat(text, size) for name, text in named.items()}


def _texts(index: np.ndarray, names: Any) -> pa.Array:
    codes = pa.array(index, pa.int32(), mask=index < 0)
    return pa.DictionaryArray.from_arrays(codes, pa.array(list(names), pa.string())).cast(pa.string())


def _numbers(column: Any, field: Any, size: int) -> pa.Array:
    if column is None:
        return pa.nulls(size, field.type)
    column = np.asarray(column, float)
    missing = np.isnan(column)
    if field.name in KEPT_NAN:
        return pa.array(column, field.type)
    if field.type == pa.float64():
        return pa.array(column, field.type, mask=missing)
    whole = np.where(missing, 0, column)
    return pa.array(whole.astype(bool if field.type == pa.bool_() else np.int64), field.type, mask=missing)


def _table(name: str, made: dict[str, Any], columns: Mapping[str, Any], size: int) -> pa.Table:
    """A table with the columns that were made; the others are a record's numbers."""
    schema = SCHEMAS[name]
    numbers = {field.name: field for field in schema if field.name not in made}
    made |= {column: _numbers(columns.get(column), field, size) for column, field in numbers.items()}
    return pa.Table.from_arrays([made[field.name] for field in schema], schema=schema)
