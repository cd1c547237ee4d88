"""A table from a Parquet file: units stand in the metadata of its fields or in their names.

Needs pyarrow, which is loaded for such a file only. What the file declares is bounded before it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.identify.errors import BadRecord, IdentifyError
from stimrig.identify.records import bounds, columns
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES, LARGEST_ROWS
from stimrig.identify.records.columns import Column, ColumnMap
from stimrig.identify.records.table import Table

UNPACKED_BYTES = 4 * LARGEST_FILE_BYTES
"""Most that a file may declare to take in memory."""
PER_S = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
RATE = b"pulse_rate_hz"
"""Entry of the table's metadata that says the pulse rate."""


def read_parquet(content: bytes, path: Path, column_map: ColumnMap) -> Table:
    """Read a table from the bytes of a Parquet file; `path` names it in messages.

    Raises BadRecord: with the file and the column, and what to do; pyarrow is missing.
    """
    name = str(path)
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
        import pyarrow.types as types
    except ImportError:
        raise BadRecord("a Parquet file needs pyarrow", place=name, fix="Install it: pip install pyarrow.") from None
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        schema, metadata = file.schema_arrow, file.metadata
        unpacked = sum(metadata.row_group(index).total_byte_size for index in range(metadata.num_row_groups))
        rows, width = metadata.num_rows, len(schema)
        if not 0 < rows <= LARGEST_ROWS or max(unpacked, 8 * rows * width) > UNPACKED_BYTES:
            message = f"{rows} rows of {width} columns, or more unpacked than a record has"
            raise BadRecord(message, place=name, fix=f"Give at least one row and at most {LARGEST_ROWS}.")
        units = ["s" if _is_time(field.type) else (field.metadata or {}).get(b"unit", b"").decode() for field in schema]
        known = columns.columns(schema.names, column_map, units, name)
        texts = [field.name for field in schema if types.is_string(field.type) or types.is_large_string(field.type)]
        # A long text that repeats is packed small: as a dictionary it stays so.
        file = pq.ParquetFile(pa.BufferReader(content), read_dictionary=texts)
        numbers, segment_names = _read_columns(file, known, name)
        if RATE in (schema.metadata or {}):
            known[RATE.decode()], numbers[RATE.decode()] = Column(0), np.array([float(schema.metadata[RATE])])
    except (IdentifyError, MemoryError):
        raise
    except Exception as error:  # the library, at a damaged file: whatever it raises
        message = f"a damaged Parquet file, or none ({type(error).__name__})"
        raise BadRecord(message, place=name, fix="Give the whole file, as it was written.") from error
    return Table.of(content, path, known, numbers, segment_names, cell=lambda row, column: f"{column}, row {row + 1}")


def _is_time(kind: Any) -> bool:
    import pyarrow.types as types

    return types.is_timestamp(kind) or types.is_duration(kind)


def _read_columns(file: Any, known: Mapping[str, Column], name: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """The known columns, each in its own unit, and the names of the segments by code."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.types as types

    numbers: dict[str, np.ndarray] = {}
    segment_names: list[str] = []
    for target, known_column in known.items():
        title = file.schema_arrow.names[known_column.index]
        table = file.read(columns=[title], use_threads=False)
        place = f"{name}, {title}"
        if table.num_columns != 1:
            raise BadRecord("not the only column of this name", place=place, fix="Rename it.")
        column, per_s = table.column(0), 1.0
        if target == "segment":
            coded = (column if types.is_dictionary(column.type) else column.dictionary_encode()).unify_dictionaries()
            segment_names = [str(text) for text in coded.chunk(0).dictionary.to_pylist()]
            if coded.null_count:
                message = f"{coded.null_count} rows without a name"
                raise BadRecord(message, place=place, fix="Name the segment of each row.")
            bounds.check_names(segment_names, place)
            numbers[target] = np.concatenate([chunk.indices.to_numpy() for chunk in coded.chunks])
            continue
        if _is_time(column.type):
            per_s, column = PER_S[column.type.unit], pc.cast(column, pa.int64())
        numeric = types.is_floating, types.is_integer, types.is_boolean, types.is_decimal
        if not any(is_kind(column.type) for is_kind in numeric):
            raise BadRecord(f"no numbers, but {column.type}", place=place, fix="Write a column of numbers.")
        numbers[target] = np.array(pc.cast(column, pa.float64(), safe=False).to_numpy(), float) / per_s
    return numbers, segment_names
