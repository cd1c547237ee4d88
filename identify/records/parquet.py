"""A record from a Parquet file: a table whose units stand in the metadata of its fields or in their names.

Needs pyarrow, which is loaded for such a file only. What the file declares is bounded before it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stimrig.identify.errors import BadRecord, IdentifyError
from stimrig.identify.records import bounds, columns
from stimrig.identify.records.assemble import record_of
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES, LARGEST_ROWS
from stimrig.identify.records.columns import Column, ColumnMap
from stimrig.identify.records.file_content import PULSE_RATE_HZ, FileContent, file_source
from stimrig.identify.records.record import Record

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

UNPACKED_BYTES = 4 * LARGEST_FILE_BYTES
"""Most that a file may declare to take in memory."""
RATE = "pulse_rate_hz"
"""Entry of the table's metadata that says the pulse rate."""


def read_parquet(content: bytes, path: Path, pulse_rate_hz: float | None, column_map: ColumnMap) -> Record:
    """Read a record of a Parquet file from its bytes; `path` is how it is called, `given` what `--map` says.

    Raises BadRecord: with the file and the column, and what to do; pyarrow is missing.
    """
    name = str(path)
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise BadRecord("a Parquet file needs pyarrow", place=name, fix="Install it: pip install pyarrow.") from None
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        schema = file.schema_arrow
        _check_size(file.metadata, len(schema), name)
        known = columns.columns(schema.names, column_map, list(map(_unit, schema)), name)
        numbers, names = _read_columns(content, schema, known, name)
        pulse_rate_hz = pulse_rate_hz or _pulse_rate(schema.metadata or {}, name)
    except (IdentifyError, MemoryError):
        raise
    except Exception as error:  # the library, at a damaged file: whatever it raises
        message = f"a damaged Parquet file, or none ({type(error).__name__})"
        raise BadRecord(message, place=name, fix="Give the whole file, as it was written.") from error
    source, rate_hz = file_source(content, path, known), pulse_rate_hz or PULSE_RATE_HZ
    return record_of(FileContent(numbers, names, name, lambda row, column: f"{column}, row {row + 1}", source, rate_hz))


def _check_size(metadata: pq.FileMetaData, width: int, name: str) -> None:
    groups = sum(metadata.row_group(index).total_byte_size for index in range(metadata.num_row_groups))
    rows = metadata.num_rows
    if not 0 < rows <= LARGEST_ROWS or max(groups, 8 * rows * width) > UNPACKED_BYTES:
        message = f"{rows} rows of {width} columns, or more unpacked than a record has"
        raise BadRecord(message, place=name, fix=f"Give at least one row and at most {LARGEST_ROWS}.")


def _unit(field: pa.Field) -> str:
    return (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")


def _read_columns(
    content: bytes, schema: pa.Schema, known: Mapping[str, Column], name: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns in our units, and the names of the segments by number."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
    import pyarrow.types as types

    texts = [field.name for field in schema if types.is_string(field.type) or types.is_large_string(field.type)]
    # A long text that repeats is packed small: as a dictionary it stays so.
    file = pq.ParquetFile(pa.BufferReader(content), read_dictionary=texts)
    numbers: dict[str, np.ndarray] = {}
    names: list[str] = []
    for target, column in known.items():
        title, kind = schema.names[column.index], schema.field(column.index).type
        table = file.read(columns=[title], use_threads=False)
        place = f"{name}, {title}"
        if table.num_columns != 1:
            raise BadRecord("not the only column of this name", place=place, fix="Rename it.")
        if target == "segment":
            numbers[target], names = _segments(table.column(0), place)
        elif types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind):
            values = pc.cast(table.column(0), pa.float64(), safe=False).to_numpy()
            numbers[target] = np.array(values, float) * column.factor
        else:
            raise BadRecord(f"no numbers, but {kind}", place=place, fix="Write a column of numbers.")
    return numbers, names


def _segments(column: pa.ChunkedArray, place: str) -> tuple[np.ndarray, list[str]]:
    """Return a number for each row's segment, and the names by number."""
    import pyarrow.types as types

    coded = (column if types.is_dictionary(column.type) else column.dictionary_encode()).unify_dictionaries()
    names = [str(name) for name in coded.chunk(0).dictionary.to_pylist()]
    if coded.null_count:
        raise BadRecord(f"{coded.null_count} rows without a name", place=place, fix="Name the segment of each row.")
    if len(names) > bounds.MOST_SEGMENTS:
        raise BadRecord(f"{len(names)} different names", place=place, fix="Name segments by what they are.")
    for text in names:
        bounds.check_name(text, place)
    return np.concatenate([chunk.indices.to_numpy() for chunk in coded.chunks]), names


def _pulse_rate(metadata: Mapping[bytes, bytes], name: str) -> float | None:
    text = metadata.get(RATE.encode())
    if text is None:
        return None
    rate_hz = float(text)
    bounds.check_rate(rate_hz, f"{name}, {RATE}")
    return rate_hz
