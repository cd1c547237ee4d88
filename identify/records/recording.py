"""A record from a sealed recording (HDF5, docs/recording.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.hdf5 import FIX, StrictFile
from stimrig.identify.records.pulse_times import Sent, in_force, locate_pulses
from stimrig.identify.records.record import Pulses, Record, Source

FORMAT = "stimrig-recording"
LONGEST_GAP_S = 0.05
"""Between two angles that are farther apart it is not known where the joint was."""
MOST_UNKNOWN = 0.5
"""With more rows than this without an angle the sensor failed, and the record has no angle."""
GROUP = "/angle"


def read_pulses(file: StrictFile, time_s: np.ndarray, pulse_rate_hz: float) -> tuple[Pulses, np.ndarray]:
    """As `locate_pulses`. Raises BadRecord: columns of different lengths, no widths, or out of order."""
    sync = file.numbers("/torque/sync") if file.has("/torque/sync") else np.full(time_s.size, 255.0)
    if sync.size != time_s.size:
        raise file.bad("columns of different lengths", "/torque/sync")
    return locate_pulses(_sent(file, 1.0 / pulse_rate_hz), time_s, sync)


def _sent(file: StrictFile, interval_s: float) -> Sent:
    names = ["planned_time_s", "sent_pulse_width_us", "written_time_s", "status"]
    names += ["acknowledged_time_s"] if file.has("/pulses/acknowledged_time_s") else []
    planned, sent, written, status, *more = file.columns("/pulses", names, "columns of different lengths")
    acknowledged = more[0] if more else written
    sent = np.where(np.isnan(sent), 0.0, sent)
    if (bad := np.flatnonzero(~((sent >= 0) & (sent <= bounds.LARGEST["pulse_width_us"])))).size:
        raise file.bad(f"{sent[bad[0]]:g} µs is no pulse width", f"/pulses/sent_pulse_width_us, pulse {bad[0]}")
    if not (np.diff(planned) > 0).all() or not np.isfinite(planned).all():
        raise file.bad("pulses do not follow one another", "/pulses/planned_time_s")
    written, acknowledged = (
        np.where(np.abs(t) <= bounds.LARGEST["time_s"], t, np.nan) for t in (written, acknowledged)
    )
    return Sent(planned, sent, written, acknowledged, status, interval_s)


def attributes(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Read root attributes of a sealed recording by name.

    Raises BadRecord: unreadable, no sealed recording, or one of them is not there.
    """
    file = StrictFile(bounds.content_of(path), str(path))
    _check_format(file)
    return {name: file.text(name) for name in names}


def read_recording(content: bytes, path: Path, pulse_rate_hz: float | None = None) -> Record:
    """Read a sealed recording from its bytes; `path` names it in messages.

    The width in force at a sample is that of the last pulse due before it, and how late that was felt stands beside
    it; a pulse that was dropped or refused counts as none. Samples outside every segment are left out. An angle
    sensor's angles are brought to the times of the torque; rows in its long gaps are doubted. Raises BadRecord:
    unreadable, half-written, with data outside the file, or without samples.
    """
    file = StrictFile(content, str(path))
    _check_format(file)
    rate = file.number("pulse_rate_hz", 40.0) if pulse_rate_hz is None else pulse_rate_hz
    bounds.check_rate(rate, f"{file.name}, attribute pulse_rate_hz")
    time_s, torque = _samples(file)
    code, names = _segments(file, time_s)
    inside = code >= 0
    if not inside.any():
        raise file.bad("no sample inside a segment", "/segments")
    if (bad := np.flatnonzero(inside & ~(np.abs(torque) <= bounds.LARGEST["torque_nm"]))).size:
        what = "is not finite" if not np.isfinite(torque[bad[0]]) else f"{torque[bad[0]]:g} N·m is no measurement"
        raise BadRecord(f"torque {what}", place=f"{file.name}, /torque/torque_nm, sample {bad[0]}", fix=FIX)
    pulses, doubted = read_pulses(file, time_s, rate)
    width, late = in_force(pulses, time_s, rate)
    angles, unknown, note = _read_angle(file, time_s, inside)
    doubted = doubted | unknown
    bounds.check_span(time_s[inside], f"{file.name}, /torque/time_s")
    identity, digest, participant = (file.text(key, "") for key in ("recording_id", "content_sha256", "participant"))
    current_ma = file.number("current_ma", np.nan)
    columns: dict[str, Any] = {"time_s": time_s, "pulse_width_us": width, "torque_nm": torque} | angles
    columns |= {"late_s": late} if pulses.late_s.any() else {}
    columns |= {"doubted": doubted} if doubted.any() else {}
    return Record.from_arrays(
        **{label: column[inside] for label, column in columns.items()},
        segment=code[inside],
        segment_names=names,
        pulses=pulses,
        pulse_rate_hz=rate,
        source=Source(
            name=path.name,
            recording_id=identity,
            sha256=digest,
            notes=(note,) if note else (),
            participant=participant,
            current_ma=current_ma if current_ma > 0.0 else None,
        ),
    )


def _check_format(file: StrictFile) -> None:
    if file.text("format", "") != FORMAT:
        raise file.bad("HDF5, but no stimrig recording")
    version = file.number("format_version", 0)
    if version != 1:
        message = f"format version {version:g}, this software reads 1"
        raise BadRecord(message, place=file.name, fix="Update the software.")


def _samples(file: StrictFile) -> tuple[np.ndarray, np.ndarray]:
    """Times, rising, and torques."""
    time_s, torque = file.columns("/torque", ("time_s", "torque_nm"), "no torque sample")
    if not time_s.size:
        raise file.bad("no torque sample", "/torque")
    _check_rising(file, time_s, "/torque/time_s")
    if not (np.abs(time_s[[0, -1]]) <= bounds.LARGEST["time_s"]).all():
        raise file.bad("times that no clock shows", "/torque/time_s")
    if time_s.size > 1:
        bounds.check_sampling(1 / float(np.median(np.diff(time_s))), f"{file.name}, /torque/time_s")
    return time_s, torque


def _check_rising(file: StrictFile, time_s: np.ndarray, path: str) -> None:
    if (backwards := np.flatnonzero(~(np.diff(time_s) > 0))).size:
        raise file.bad("time runs backwards", f"{path}, sample {backwards[0] + 1}")


def _segments(file: StrictFile, time_s: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """For each sample the segment it lies in, −1 for none, and the segments' names."""
    starts, ends = file.numbers("/segments/start_s"), file.numbers("/segments/end_s")
    names = file.names("/segments/name")
    if not (starts.size == ends.size == len(names)):
        raise file.bad("names, starts and ends differ in number", "/segments")
    if not ((np.diff(starts) >= 0).all() and (ends >= starts).all()):
        raise file.bad("segments do not follow one another", "/segments")
    bounds.check_names(names, f"{file.name}, /segments/name")
    if not names:
        return np.full(time_s.size, -1), names
    order = np.searchsorted(starts, time_s, side="right") - 1
    inside = (order >= 0) & (time_s < ends[np.maximum(order, 0)] + 1e-9)
    return np.where(inside, order, -1), names


def _read_angle(
    file: StrictFile, time_s: np.ndarray, inside: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, str]:
    """Angle and velocity at the torque's times, linear between the sensor's samples; rows without any; and a note.

    There is no column where the rig had no sensor, or where it failed in the rows that make the record, `inside`.
    """
    nothing = np.zeros(time_s.size, bool)
    if not file.has(GROUP):
        return {}, nothing, ""
    names = ("time_s", "angle_rad", "velocity_rad_s")
    columns = dict(zip(names, file.columns(GROUP, names, "times, angles and velocities differ in number"), strict=True))
    _check_rising(file, columns["time_s"], f"{GROUP}/time_s")
    for label, values in columns.items():
        if (bad := np.flatnonzero(~(np.abs(values) <= bounds.LARGEST[label]))).size:
            raise file.bad(f"{label} {values[bad[0]]:g} is no measurement", f"{GROUP}/{label}, sample {bad[0]}")
    at_s = columns.pop("time_s")
    unknown = _unknown(at_s, time_s)
    share = float(np.mean(unknown[inside]))
    if share > MOST_UNKNOWN:
        return {}, nothing, f"no angle: the angle sensor gave none in {share:.0%} of the record"
    return {label: np.interp(time_s, at_s, values) for label, values in columns.items()}, unknown, ""


def _unknown(at_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Rows in a long gap between the sensor's samples, before the first or after the last."""
    if at_s.size < 2:
        return np.ones(time_s.size, bool)
    after = np.clip(np.searchsorted(at_s, time_s), 1, at_s.size - 1)
    within = (time_s > at_s[after - 1]) & (time_s < at_s[after]) & (at_s[after] - at_s[after - 1] > LONGEST_GAP_S)
    return within | (time_s < at_s[0] - LONGEST_GAP_S) | (time_s > at_s[-1] + LONGEST_GAP_S)
