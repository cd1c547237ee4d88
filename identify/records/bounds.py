"""Bounds of a record: every reader refuses what lies outside before it allocates memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord

LARGEST_FILE_BYTES = 256 * 2**20
PIECE_BYTES = 2**20
LARGEST_ROWS = 5_000_000
"""Forty minutes at the highest rate; a file of more is cut, or sampled at a lower rate."""
LEAST_SAMPLES = 8
LONGEST_S = 24 * 3600.0
"""From the first sample to the last, pauses included."""
LOWEST_HZ, HIGHEST_HZ = 39.0, 2100.0
LARGEST = {
    "time_s": 1e7,
    "pulse_width_us": 1e4,
    "torque_nm": 1e6,
    "angle_rad": 7.0,
    "velocity_rad_s": 1e5,
    "late_s": 1.0,
    "doubted": 1.0,
    "part": 1e3,
}
MAY_LACK = ("time_s", "pulse_width_us", "torque_nm", "angle_rad", "velocity_rad_s")
"""Columns in which a number may be missing: a row without one is left out."""
LARGEST_CALENDAR_S = 1e11
"""Times as they are read may be counted from 1970, or from 1904."""
LONGEST_NAME = 100
LONGEST_TEXT = 10_000
LONGEST_PLAN = 8 * 2**20
"""Longest text that the rig writes of a test (configuration, events): a plan lists each pulse of its trains."""
MOST_SEGMENTS = 1000
MOST_PARTS = 1000
PULSE_RATES_HZ = (1.0, 200.0)


def content_of(path: Path) -> bytes:
    """A file's bytes, at most as many as a record can have. Raises BadRecord: it cannot be read, or is larger."""
    try:
        with path.open("rb") as file:
            pieces = [file.read(PIECE_BYTES)]
            while pieces[-1] and len(pieces) * PIECE_BYTES <= LARGEST_FILE_BYTES:
                pieces.append(file.read(PIECE_BYTES))
    except (FileNotFoundError, ValueError) as error:  # a ValueError: a NUL in the name
        raise BadRecord("no such file", place=str(path).replace("\0", "\\0"), fix="Check the path.") from error
    except IsADirectoryError as error:
        raise BadRecord("a directory, not a record", place=str(path), fix="Name the file in it.") from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadRecord(f"can't be read ({reason})", place=str(path), fix="Check its rights.") from error
    if sum(map(len, pieces)) > LARGEST_FILE_BYTES:
        fix = "Cut the record, or give the sealed recording."
        raise BadRecord(f"more than {LARGEST_FILE_BYTES // 2**20} MB", place=str(path), fix=fix)
    return b"".join(pieces)


def check_size(size: int, place: str) -> None:
    """Refuse what is no record but a handful of samples. Raises BadRecord: fewer than 8."""
    if size < LEAST_SAMPLES:
        raise BadRecord(f"only {size} samples", place=place, fix="Give a few seconds of data.")


def check_rate(pulse_rate_hz: float, place: str) -> None:
    """Refuse a pulse rate that no stimulator has. Raises BadRecord: outside 1 to 200 Hz, or no number."""
    lo, hi = PULSE_RATES_HZ
    if not (lo <= pulse_rate_hz <= hi):
        raise BadRecord(f"{pulse_rate_hz:g} pulses a second", place=place, fix=f"Give {lo:g} to {hi:g} Hz.")


def check_sampling(rate_hz: float, place: str) -> None:
    """Refuse a rate of sampling at which no muscle is identified.

    Raises BadRecord: below 40 Hz or above 2 kHz, by more than rounding.
    """
    if not (LOWEST_HZ <= rate_hz <= HIGHEST_HZ):
        units = {"ms": 1e-3, "µs": 1e-6, "ns": 1e-9, "d": 86400.0}
        fitting = [unit for unit, unit_s in units.items() if LOWEST_HZ <= rate_hz / unit_s <= HIGHEST_HZ]
        units_to_give = "".join(f"; for time in {unit}, give --map time_s=time_s:{unit}" for unit in fitting)
        fix = f"40 Hz to 2 kHz can be used{units_to_give}."
        raise BadRecord(f"sampled at {rate_hz:.4g} Hz", place=place, fix=fix)


def check_names(names: list[str], place: str) -> None:
    """Refuse segments' names that are none.

    Raises BadRecord: too many; one is empty, too long, or with signs that cannot be printed.
    """
    if len(names) > MOST_SEGMENTS:
        fix = "Name segments by what they are (rest, prbs…), not each row."
        raise BadRecord(f"more than {MOST_SEGMENTS} names", place=place, fix=fix)
    for name in names:
        if not name.strip():
            raise BadRecord("empty", place=place, fix="Name it: rest, prbs, ramp, validate…")
        if len(name) > LONGEST_NAME:
            fix = f"A segment's name has at most {LONGEST_NAME}."
            raise BadRecord(f"a name of {len(name)} characters", place=place, fix=fix)
        if not name.isprintable():
            raise BadRecord("a name that cannot be printed", place=place, fix="Use letters, digits, - and _.")


def check_span(time_s: np.ndarray, place: str) -> None:
    """Refuse a record that no session lasts. Raises BadRecord: longer than a day."""
    span_s = float(time_s[-1] - time_s[0])
    if not (span_s <= LONGEST_S):
        fix = f"At most {LONGEST_S / 3600:g} h in one record; is the time in seconds?"
        raise BadRecord(f"from the first to the last sample {span_s:.6g} s", place=place, fix=fix)
