"""Records from files: tables (CSV, MAT, Parquet) or a sealed recording (HDF5); see docs/recording.md."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from stimrig.identify.errors import BadRecord

if TYPE_CHECKING:
    from stimrig.identify.records.record import Record

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""First bytes of a sealed recording; the service checks them without loading a reader."""
PARQUET_MAGIC = b"PAR1"


def read(
    path: str | Path, pulse_rate_hz: float | None = None, map: Mapping[str, str] | Iterable[str] | None = None
) -> Record:
    """Read a record; its `notes` list the assumptions made.

    Parameters
    ----------
    path : str or Path
        CSV with the header `time_s,pulse_width_us,torque_nm,segment` (and optionally `angle_rad`, `velocity_rad_s`,
        `late_s`, `doubted`, and the columns of a joined record), a table, MAT or Parquet file of another tool, or a
        sealed recording. Parquet needs pyarrow.
    pulse_rate_hz : float, optional
        Pulses a second; by default what the recording says, else 40.
    map : mapping or sequence of str, optional
        Columns of another tool's file by ours: `{"torque_nm": "Drehmoment:Nm"}`, or `["torque_nm=Drehmoment:Nm"]`. The
        unit after the last colon may be left out where the column's name holds it; `#3` is the third column.

    Raises
    ------
    BadRecord
        With file, line and column, and what to do.
    """
    from stimrig.identify.records import bounds, columns, csv, join
    from stimrig.identify.records.clock import regular
    from stimrig.identify.records.segments import with_segments
    from stimrig.identify.records.table import checked

    path = Path(path)
    if pulse_rate_hz is not None:
        bounds.check_rate(pulse_rate_hz, "pulse rate")
    column_map = columns.parse_column_map(map)
    content = bounds.content_of(path)
    if content.startswith(HDF5_MAGIC):
        from stimrig.identify.records.recording import read_recording

        if column_map:
            raise BadRecord("a sealed recording has its own columns", place=str(path), fix="Leave --map out.")
        return read_recording(content, path, pulse_rate_hz)
    if (content.startswith(b"MATLAB") and content[126:128] in (b"IM", b"MI")) or path.suffix.lower() == ".mat":
        from stimrig.identify.records.mat import read_mat as read_table
    elif content.startswith(PARQUET_MAGIC) or path.suffix.lower() == ".parquet":
        from stimrig.identify.records.parquet import read_parquet as read_table
    else:
        read_table = csv.read_csv
    table = read_table(content, path, column_map)
    table = checked(table if pulse_rate_hz is None else replace(table, pulse_rate_hz=pulse_rate_hz))
    return join.record_of_parts(table) if table.part_cells else with_segments(regular(table)).record()
