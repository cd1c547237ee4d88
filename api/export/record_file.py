"""Write one record as a CSV, MAT or Parquet file; `write_record` chooses by the end of the file's name."""

from __future__ import annotations

import importlib.util
import io
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRequest
from stimrig.identify.records.columns import COMMON_UNITS
from stimrig.identify.records.join import write_joined
from stimrig.identify.records.record import Record

MAT_HEADER = b"MATLAB 5.0 MAT-file, written by stimrig"  # without today's date, which scipy would write


def write_mat(record: Record, path: Path) -> None:
    """Write columns as variables: those of `Record.samples`, `segment` and `pulse_rate_hz`."""
    from scipy.io import savemat

    variables = {
        **{name: np.asarray(column, float) for name, column in record.samples().items()},
        "segment": np.array(record.segment_names)[record.segment],
        "pulse_rate_hz": record.pulse_rate_hz,
    }
    packed = io.BytesIO()
    savemat(packed, variables, do_compression=True, oned_as="column")
    path.write_bytes(MAT_HEADER.ljust(116) + packed.getvalue()[116:])


def write_parquet(record: Record, path: Path) -> None:
    """Write one table; the metadata of each field hold its unit, those of the table the pulse rate."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    samples = record.samples()
    fields = [pa.field(name, pa.float64(), metadata={"unit": COMMON_UNITS.get(name, ("1",))[0]}) for name in samples]
    arrays = [pa.array(np.asarray(column, float)) for column in samples.values()]
    segments = pa.DictionaryArray.from_arrays(pa.array(record.segment, pa.int32()), list(record.segment_names))
    schema = pa.schema(
        [*fields, pa.field("segment", pa.string())], {"pulse_rate_hz": repr(float(record.pulse_rate_hz))}
    )
    pq.write_table(pa.Table.from_arrays([*arrays, segments.cast(pa.string())], schema=schema), path, compression="zstd")


WRITERS = {"csv": write_joined, "mat": write_mat, "parquet": write_parquet}
"""The writer of each format; the format is also the end of the file's name."""


def check_format(format: str) -> None:
    """Raise BadRequest: there is no such format, or pyarrow is missing."""
    if format not in WRITERS:
        raise BadRequest("no such format", place=f"format {format}", fix=f"Give one of {', '.join(WRITERS)}.")
    if format == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise BadRequest("Parquet needs pyarrow", place="format parquet", fix="Install it: pip install pyarrow.")


def write_record(record: Record, path: Path, format: str) -> None:
    """Write a record in a format of `WRITERS`.

    Raises BadRequest: as `check_format`, or it is a joined record, whose parts only CSV can hold.
    """
    check_format(format)
    if len(record.parts) > 1 and format != "csv":
        message = f"it is joined of {len(record.parts)} recordings, which {format} cannot hold"
        raise BadRequest(message, place=str(path), fix="Write it as CSV.")
    WRITERS[format](record, path)
