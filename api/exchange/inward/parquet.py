"""Parquet in: the columns of one file. One of `stimrig export --parquet` (`samples/…`) is taken as it was exported."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.api.exchange.inward.foreign import Foreign, Signal, Spans, plain, spans_of_rows
from stimrig.identify.errors import BadRecord
from stimrig.identify.records import columns
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES, LARGEST_ROWS, MOST_SEGMENTS

NAME = "Parquet"
MAGIC = b"PAR1"
OWN = ("time_s", "torque_nm", "pulse_width_us", "segment", "held_out", "late_s", "doubted", "record_id")
UNPACKED_BYTES = 4 * LARGEST_FILE_BYTES
TEXTS = {"record_id": "recording_id", "participant": "participant"}


def reads(_path: Path, head: bytes) -> bool:
    """By its first bytes."""
    return head.startswith(MAGIC)


def read(path: Path, content: bytes) -> Foreign:
    """What a Parquet file holds. Raises BadRecord."""
    import pyarrow.parquet as pq

    file = pq.ParquetFile(io.BytesIO(content))
    schema, rows = file.schema_arrow, file.metadata.num_rows
    groups = (file.metadata.row_group(k).total_byte_size for k in range(file.metadata.num_row_groups))
    numbers = 8 * rows * sum(_is_number(column.type) for column in schema)  # in memory: repeated ones are packed small
    if not 0 < rows <= LARGEST_ROWS or max(sum(groups), numbers) > UNPACKED_BYTES:
        message = f"{rows} rows, or more unpacked than a record has"
        raise BadRecord(message, place=str(path), fix=f"At most {LARGEST_ROWS} rows are read.")
    own = set(OWN) <= set(schema.names)
    time = next((name for name in schema.names if name == "time_s"), None) or _time(schema)
    if time is None:
        message = "no column of times: none is called time_s, or time with its unit"
        raise BadRecord(message, place=str(path), fix=f"Rename it; the file has {', '.join(schema.names[:12])}.")
    names = [field.name for field in schema if _is_number(field.type)]
    factor = columns.unit_factor("time_s", _unit(schema.field(time)) or "s") or 1.0
    time_s = _numbers(file, time) * factor
    signals = tuple(
        Signal(name, time_s, _numbers(file, name), _unit(schema.field(name))) for name in names if name != time
    )
    spans = tuple(_spans(file, field.name, time_s) for field in schema if field.name.lower() in ("segment", "segments"))
    about = {called: _first(file, name) for name, called in TEXTS.items() if name in schema.names}
    return Foreign(NAME, signals, spans, _own(path, signals, about) if own else {}, about)


def _time(schema: Any) -> str | None:
    """A column whose name is one for times and whose unit is said, alone of its kind."""
    found = [name for name, column in ((one.name, one) for one in schema) if "time_s" in columns.places([name], {})
             and columns.unit_factor("time_s", _unit(column)) is not None]  # fmt: skip
    return found[0] if len(found) == 1 else None


def _is_number(kind: Any) -> bool:
    import pyarrow.types as types

    return types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind)


def _unit(field: Any) -> str:
    """What the column's metadata say, else the end of its name."""
    said = (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")
    return plain(said or columns._split(field.name)[1])


def _numbers(file: Any, name: str) -> np.ndarray:
    import pyarrow as pa
    import pyarrow.compute as pc

    column = file.read(columns=[name]).column(0)
    return pc.cast(column, pa.float64()).to_numpy(zero_copy_only=False).astype(float)


def _first(file: Any, name: str) -> str:
    """What stands in the first row."""
    return str(file.read(columns=[name]).column(0)[0].as_py() or "")


def _spans(file: Any, name: str, time_s: np.ndarray) -> Spans:
    coded = file.read(columns=[name]).column(0).combine_chunks().dictionary_encode()
    names = [str(one) for one in coded.dictionary.to_pylist()]
    if len(names) > MOST_SEGMENTS:
        raise BadRecord(
            f"{len(names)} different names in {name}", place="segments", fix="Name segments by what they are."
        )
    return spans_of_rows(name, time_s, coded.indices.fill_null(-1).to_numpy(zero_copy_only=False), names)


def _own(path: Path, signals: tuple[Signal, ...], about: dict[str, Any]) -> dict[str, str]:
    """The answers, where our export wrote the file; the pulse rate stands in `records.parquet` above it."""
    there = {one.name: one for one in signals if not np.isnan(one.values).all()}
    own = {
        name: f"{name}:{there[name].unit}" if there[name].unit else name for name in columns.TARGETS if name in there
    }
    return {**own, **_rate(path, str(about.get("recording_id"))), "segments": "segment", "sign": "+1"}


def _rate(path: Path, record_id: str) -> dict[str, str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    for folder in list(path.resolve().parents)[:4]:
        try:
            listed = pq.read_table(folder / "records.parquet", columns=["record_id", "pulse_rate_hz"])
        except (OSError, pa.ArrowException):
            continue
        rates = [row["pulse_rate_hz"] for row in listed.to_pylist() if row["record_id"] == record_id]
        return {"pulse-rate-hz": json.dumps(rates[0])} if rates and rates[0] else {}
    return {}
