"""Records from files: CSV, or a sealed recording (HDF5, docs/recording.md)."""

from __future__ import annotations

from pathlib import Path

from identify.errors import BadRecord
from identify.record import Record

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def read(path: str | Path, pulse_rate_hz: float | None = None) -> Record:
    """Read a record.

    Parameters
    ----------
    path : str or Path
        CSV with the header `time_s,pulse_width_us,torque_nm,segment` (and optionally `angle_rad,velocity_rad_s`), or
        a sealed recording.
    pulse_rate_hz : float, optional
        Pulses a second; by default what the recording says, else 40.

    Raises
    ------
    BadRecord
        With file, line and column, and the mend.
    """
    path = Path(path)
    if pulse_rate_hz is not None and not 1.0 <= pulse_rate_hz <= 200.0:
        raise BadRecord(f"{pulse_rate_hz:g} pulses a second", place="pulse rate", mend="Give 1 to 200 Hz.")
    try:
        with path.open("rb") as file:
            magic = file.read(8)
    except FileNotFoundError as error:
        raise BadRecord("no such file", place=str(path), mend="Check the path.") from error
    except IsADirectoryError as error:
        raise BadRecord("a directory, not a record", place=str(path), mend="Name the file in it.") from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadRecord(f"can't be read ({reason})", place=str(path), mend="Check its rights.") from error
    if magic == HDF5_MAGIC:
        from identify.recording import read_recording

        return read_recording(path, pulse_rate_hz)
    from identify.csv_record import read_csv

    return read_csv(path, 40.0 if pulse_rate_hz is None else pulse_rate_hz)
