"""A record from a sealed recording (HDF5, docs/recording.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.felt import read_pulses
from stimrig.identify.records.hdf5 import FIX, StrictFile
from stimrig.identify.records.record import Pulses, Record, Source

FORMAT = "stimrig-recording"
LONGEST_GAP_S = 0.05
"""Between two angles that are farther apart it is not known where the joint was."""
MOST_UNKNOWN = 0.5
"""With more rows than this without an angle the sensor failed, and the record has no angle."""
GROUP = "/angle"


def attributes(path: Path, names: Sequence[str]) -> dict[str, str]:
    """What a sealed recording says of itself, by the names of its root's attributes.

    Raises
    ------
    BadRecord
        Unreadable, no sealed recording, or one of them is not there.
    """
    file = StrictFile(bounds.content_of(path), str(path))
    _check_format(file)
    return {name: file.text(name) for name in names}


def read_recording(content: bytes, path: Path, pulse_rate_hz: float | None = None) -> Record:
    """A sealed recording from its bytes; `path` is how it is called.

    The width in force at a sample is that of the last pulse due before it, and how late that was felt stands beside
    it; a pulse that was dropped or refused counts as none. Samples outside every segment are left out.
    An angle sensor's angles are brought to the times of the torque; rows in its long gaps are doubted.

    Raises
    ------
    BadRecord
        Unreadable, half-written, with data outside the file, or without samples.
    """
    name = str(path)
    file = StrictFile(content, name)
    _check_format(file)
    rate = file.number("pulse_rate_hz", 40.0) if pulse_rate_hz is None else pulse_rate_hz
    bounds.check_rate(rate, f"{name}, attribute pulse_rate_hz")
    time_s, torque = _samples(file, name)
    code, names = _segments(file, name, time_s)
    inside = code >= 0
    if not inside.any():
        raise BadRecord("no sample inside a segment", place=f"{name}, /segments", fix=FIX)
    largest = bounds.LARGEST["torque_nm"]
    if (bad := np.flatnonzero(inside & ~(np.abs(torque) <= largest))).size:
        what = "is not finite" if not np.isfinite(torque[bad[0]]) else f"{torque[bad[0]]:g} N·m is no measurement"
        raise BadRecord(f"torque {what}", place=f"{name}, /torque/torque_nm, sample {bad[0]}", fix=FIX)
    pulses, doubts = read_pulses(file, name, time_s, rate)
    width, late = _in_force(pulses, time_s, rate)
    angle, note = _read_angle(file, name, time_s, inside)
    if angle is not None:
        doubts = doubts | angle.unknown
    bounds.check_span(time_s[inside], f"{name}, /torque/time_s")
    identity, digest, whose = (file.text(key, "") for key in ("recording_id", "content_sha256", "participant"))
    source = Source(path.name, identity, digest, notes=(note,) if note else (), participant=whose)
    return Record.from_arrays(
        time_s[inside], width[inside], torque[inside], code[inside], segment_names=names, pulse_rate_hz=rate,
        source=source, pulses=pulses,
        angle_rad=None if angle is None else angle.angle_rad[inside],
        velocity_rad_s=None if angle is None else angle.velocity_rad_s[inside],
        late_s=late[inside] if pulses.late_s.any() else None,
        doubted=doubts[inside] if doubts.any() else None,
    )  # fmt: skip


def _check_format(file: StrictFile) -> None:
    if file.text("format", "") != FORMAT:
        raise BadRecord("HDF5, but no stimrig recording", place=file.name, fix=FIX)
    version = file.number("format_version", 0)
    if version != 1:
        raise BadRecord(
            f"format version {version:g}, this software reads 1", place=file.name, fix="Update the software."
        )


def _samples(file: StrictFile, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Times, rising, and torques."""
    time_s, torque = file.numbers("/torque/time_s"), file.numbers("/torque/torque_nm")
    if time_s.size != torque.size or not time_s.size:
        raise BadRecord("no torque sample", place=f"{name}, /torque", fix=FIX)
    backwards = np.flatnonzero(~(np.diff(time_s) > 0))
    if backwards.size:
        raise BadRecord("time runs backwards", place=f"{name}, /torque/time_s, sample {backwards[0] + 1}", fix=FIX)
    if not (np.abs(time_s[[0, -1]]) <= bounds.LARGEST["time_s"]).all():
        raise BadRecord("times that no clock shows", place=f"{name}, /torque/time_s", fix=FIX)
    if time_s.size > 1:
        bounds.check_sampling(1 / float(np.median(np.diff(time_s))), f"{name}, /torque/time_s")
    return time_s, torque


def _segments(file: StrictFile, name: str, time_s: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """For each sample the segment it lies in, −1 for none, and the segments' names."""
    starts, ends = file.numbers("/segments/start_s"), file.numbers("/segments/end_s")
    names = file.names("/segments/name")
    if not (starts.size == ends.size == len(names)):
        raise BadRecord("names, starts and ends differ in number", place=f"{name}, /segments", fix=FIX)
    if not ((np.diff(starts) >= 0).all() and (ends >= starts).all()):
        raise BadRecord("segments do not follow one another", place=f"{name}, /segments", fix=FIX)
    for index, text in enumerate(names):
        bounds.check_name(text, f"{name}, /segments/name, segment {index}")
    if not names:
        return np.full(time_s.size, -1), names
    order = np.searchsorted(starts, time_s, side="right") - 1
    inside = (order >= 0) & (time_s < ends[np.maximum(order, 0)] + 1e-9)
    return np.where(inside, order, -1), names


def _in_force(pulses: Pulses, time_s: np.ndarray, pulse_rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Width and lateness of the pulse in force at each sample, by the even slots."""
    if not pulses.time_s.size:
        return np.zeros(time_s.size), np.zeros(time_s.size)
    last = np.searchsorted(pulses.time_s, time_s + 1e-9, side="right") - 1
    # A slot without a pulse, at a gap or after the end, is no stimulation.
    inside = (last >= 0) & (time_s - pulses.time_s[np.maximum(last, 0)] < 1.5 / pulse_rate_hz)
    last = np.maximum(last, 0)
    return np.where(inside, pulses.width_us[last], 0.0), np.where(inside, pulses.late_s[last], 0.0)


@dataclass(frozen=True)
class _Angle:
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


def _read_angle(file: StrictFile, name: str, time_s: np.ndarray, inside: np.ndarray) -> tuple[_Angle | None, str]:
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
    _check_angle(at_s, angle, velocity, name)
    unknown = _unknown(at_s, time_s)
    share = float(np.mean(unknown[inside]))
    if share > MOST_UNKNOWN:
        return None, f"no angle: the angle sensor gave none in {share:.0%} of the record"
    return _Angle(np.interp(time_s, at_s, angle), np.interp(time_s, at_s, velocity), unknown), ""


def _check_angle(at_s: np.ndarray, angle: np.ndarray, velocity: np.ndarray, name: str) -> None:
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
