"""Parquet: `samples/` and `pulses/` as partitioned datasets, `records.parquet` with one row a record, a dictionary."""

from __future__ import annotations

import json
from itertools import islice
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stimrig.api.cohort import dictionary
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.handed_on import Put, Who
from stimrig.api.cohort.opened import Opened
from stimrig.api.cohort.table import table_of

NAME: str = "parquet"
STATUS = ("acknowledged", "rest", "dropped", "refused", "unacknowledged", "device error")
HELD_OUT = "validate"
ROWS = 2000
"""Rows of `records.parquet` that are held in memory at once."""
KEPT_NAN = ("time_s", "torque_nm")


def write(record: Opened, who: Who, put: Put) -> dict[str, Any]:
    """The record's samples and pulses; its row of `records`."""
    place = f"sub={who.label}/ses={who.session}/{who.key}.parquet"
    with put(f"samples/{place}") as file:
        pq.write_table(samples(record, who), file, compression="zstd")
    with put(f"pulses/{place}") as file:
        pq.write_table(pulses(record, who), file, compression="zstd")
    return record_row(record, who)


def finish(state: State, put: Put) -> None:
    """`records.parquet` and the dictionary."""
    schema = dictionary.schema("records")
    with put("records.parquet") as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        rows = (row for _, _, row in state.rows())
        while batch := list(islice(rows, ROWS)):
            writer.write_table(table_of(batch, schema))
    for name, text in (
        ("data_dictionary.json", dictionary.as_json("stimrig export, Parquet")),
        ("data_dictionary.csv", dictionary.as_csv()),
    ):
        with put(name) as file:
            file.write(text.encode())


def samples(record: Opened, who: Who) -> pa.Table:
    """The table of a record's samples."""
    columns, size = record.samples, len(record.samples["time_s"])
    index = columns["segment"].astype(int)
    names = record.about["segment_names"]
    made: dict[str, Any] = {
        **_who(who, size),
        "segment": _texts(index, names),
        "segment_index": pa.array(index, pa.int64(), mask=index < 0),
        "held_out": pa.array(np.isin(index, [i for i, name in enumerate(names) if name == HELD_OUT])),
    }
    for field in dictionary.schema("samples"):
        if field.name not in made:
            made[field.name] = _numbers(columns.get(field.name), field, size)
    return _table("samples", made)


def pulses(record: Opened, who: Who) -> pa.Table:
    """The table of a record's pulses; empty where it has no list of them."""
    columns = record.pulses
    size = len(next(iter(columns.values()), []))
    made: dict[str, Any] = {**_who(who, size), "index": pa.array(np.arange(size), pa.int64())}
    status = columns.get("status", np.full(size, -1.0))
    status = np.where(np.isin(status, range(len(STATUS))), status, -1).astype(int)
    made["status"] = _texts(status, STATUS)
    planned_s = columns.get("planned_time_s", np.empty(0))
    made["segment"] = _texts(segment_at(record, planned_s), [name for name, _, _ in record.segments])
    for field in dictionary.schema("pulses"):
        if field.name not in made:
            made[field.name] = _numbers(columns.get(field.name), field, size)
    return _table("pulses", made)


def segment_at(record: Opened, time_s: np.ndarray) -> np.ndarray:
    """Index of the segment that each time lies in; −1: none."""
    starts = np.array([start for _, start, _ in record.segments])
    ends = np.array([end for _, _, end in record.segments])
    if not len(starts):
        return np.full(len(time_s), -1)
    found = np.searchsorted(starts, time_s + 1e-9, side="right") - 1
    inside = (found >= 0) & (time_s < ends[np.maximum(found, 0)] - 1e-9)
    return np.where(inside, found, -1)


def record_row(record: Opened, who: Who) -> dict[str, Any]:
    """A record's row of `records`."""
    about = record.about
    plan = _plan(about.get("configuration"))
    row = {column.name: about.get(column.name) for column in dictionary.columns("records")}
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


def _table(name: str, made: dict[str, Any]) -> pa.Table:
    schema = dictionary.schema(name)
    return pa.Table.from_arrays([made[field.name] for field in schema], schema=schema)
