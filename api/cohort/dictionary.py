"""The data dictionary of an export: each column with its meaning, unit, type, range and where it comes from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from stimrig.identify.records.cells import lines

Kind = Literal["text", "number", "integer", "true or false", "time"]


@dataclass(frozen=True)
class Column:
    """One column."""

    table: str
    name: str
    type: Kind
    unit: str
    meaning: str
    range: str
    source: str


WHO: tuple[tuple[str, Kind, str, str, str, str], ...] = (
    ("record_id", "text", "", "id of the recording; of a table its first 16 digits of the SHA-256", "", "recording_id"),
    ("participant", "text", "", "code of the participant, as it was given", "", "participant"),
    ("session", "text", "", "session: the day of the recording (UTC), or the label in its place", "", "created_utc"),
)
COLUMNS: dict[str, tuple[tuple[str, Kind, str, str, str, str], ...]] = {
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
        ("rig", "text", "", "id of the rig, where a centre knows it", "", "centre"),
        ("test_id", "text", "", "id of the test", "", "test_id"),
        ("kind", "text", "", "kind of test", "", "kind"),
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
}  # fmt: skip


def columns(table: str) -> list[Column]:
    """The columns of a table."""
    return [Column(table, *entry) for entry in COLUMNS[table]]


def schema(table: str) -> Any:
    """A table's Arrow schema; unit and meaning stand in each field's metadata."""
    import pyarrow as pa

    types = {
        "text": pa.string(),
        "number": pa.float64(),
        "integer": pa.int64(),
        "true or false": pa.bool_(),
        "time": pa.timestamp("us", tz="UTC"),
    }
    return pa.schema([
        pa.field(c.name, types[c.type], metadata={"unit": c.unit, "description": c.meaning}) for c in columns(table)
    ])  # fmt: skip


def as_json(title: str) -> str:
    """The dictionary for programs."""
    tables = {name: {c.name: _described(c) for c in columns(name)} for name in COLUMNS}
    return json.dumps({"title": title, "tables": tables}, ensure_ascii=False, indent=2) + "\n"


def as_csv() -> str:
    """The dictionary as a table, for a spreadsheet."""
    names = [field.name for field in fields(Column)]
    rows = (asdict(column).values() for name in COLUMNS for column in columns(name))
    return "".join(lines([names, *rows]))


def _described(column: Column) -> dict[str, str]:
    return {key: value for key, value in asdict(column).items() if key not in ("table", "name")}
