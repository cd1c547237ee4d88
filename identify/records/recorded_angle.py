"""The joint's angle in a sealed recording, brought to the times of its torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.errors import BadRecord
from identify.records import bounds
from identify.records.hdf5 import FIX, StrictFile

LONGEST_GAP_S = 0.05
"""Between two angles that are farther apart it is not known where the joint was."""
MOST_UNKNOWN = 0.5
"""With more rows than this without an angle the sensor failed, and the record has no angle."""
GROUP = "/angle"


@dataclass(frozen=True)
class RecordedAngle:
    """Angle and velocity at each torque sample.

    Parameters
    ----------
    angle_rad, velocity_rad_s : ndarray, shape (N,)
        Linear between the sensor's samples.
    unknown : ndarray of bool, shape (N,)
        Rows in a long gap between them, before the first or after the last.
    """

    angle_rad: np.ndarray
    velocity_rad_s: np.ndarray
    unknown: np.ndarray


def read_angle(file: StrictFile, name: str, time_s: np.ndarray, inside: np.ndarray) -> tuple[RecordedAngle | None, str]:
    """The angle at the times of the torque, and a note; None where the rig had no sensor or its sensor failed.

    Parameters
    ----------
    time_s : ndarray, shape (N,)
        Of the torque, s, rising.
    inside : ndarray of bool, shape (N,)
        The rows that make the record.

    Raises
    ------
    BadRecord
        Incomplete, or with values that no joint has.
    """
    if not file.has(GROUP):
        return None, ""
    at_s = file.numbers(f"{GROUP}/time_s")
    angle, velocity = file.numbers(f"{GROUP}/angle_rad"), file.numbers(f"{GROUP}/velocity_rad_s")
    _check(at_s, angle, velocity, name)
    unknown = _unknown(at_s, time_s)
    share = float(np.mean(unknown[inside]))
    if share > MOST_UNKNOWN:
        return None, f"no angle: the angle sensor gave none in {share:.0%} of the record"
    return RecordedAngle(np.interp(time_s, at_s, angle), np.interp(time_s, at_s, velocity), unknown), ""


def _check(at_s: np.ndarray, angle: np.ndarray, velocity: np.ndarray, name: str) -> None:
    if not (at_s.size == angle.size == velocity.size):
        raise BadRecord("times, angles and velocities differ in number", place=f"{name}, {GROUP}", fix=FIX)
    if (backwards := np.flatnonzero(~(np.diff(at_s) > 0))).size:
        place = f"{name}, {GROUP}/time_s, sample {backwards[0] + 1}"
        raise BadRecord("time runs backwards", place=place, fix=FIX)
    for label, values in (("time_s", at_s), ("angle_rad", angle), ("velocity_rad_s", velocity)):
        if (bad := np.flatnonzero(~(np.abs(values) <= bounds.LARGEST[label]))).size:
            place = f"{name}, {GROUP}/{label}, sample {bad[0]}"
            raise BadRecord(f"{label} {values[bad[0]]:g} is no measurement", place=place, fix=FIX)


def _unknown(at_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    if at_s.size < 2:
        return np.ones(time_s.size, bool)
    after = np.clip(np.searchsorted(at_s, time_s), 1, at_s.size - 1)
    within = (time_s > at_s[after - 1]) & (time_s < at_s[after]) & (at_s[after] - at_s[after - 1] > LONGEST_GAP_S)
    return within | (time_s < at_s[0] - LONGEST_GAP_S) | (time_s > at_s[-1] + LONGEST_GAP_S)
