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
from stimrig.identify.records.record import Record, Source

FORMAT = "stimrig-recording"
LONGEST_GAP_S = 0.05
"""Between two angles that are farther apart it is not known where the joint was."""
MOST_UNKNOWN = 0.5
"""With more rows than this without an angle the sensor failed, and the record has no angle."""
GROUP = "/angle"


def attributes(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Read root attributes of a sealed recording by name.

    Raises BadRecord: unreadable, no sealed recording, or one of them is not there.
    """
    file = _open(bounds.content_of(path), path)
    return {name: file.text(name) for name in names}


def read_recording(content: bytes, path: Path, pulse_rate_hz: float | None = None) -> Record:
    """Read a sealed recording from its bytes; `path` names it in messages.

    The width in force at a sample is that of the last pulse due before it, and how late that was felt stands beside
    it; a pulse that was dropped or refused counts as none. Samples outside every segment are left out. An angle
    sensor's angles are brought to the times of the torque; rows in its long gaps are doubted. Raises BadRecord:
    unreadable, half-written, with data outside the file, or without samples.
    """
    file = _open(content, path)
    rate = file.number("pulse_rate_hz", 40.0) if pulse_rate_hz is None else pulse_rate_hz
    bounds.check_rate(rate, f"{file.name}, attribute pulse_rate_hz")
    time_s, torque_nm, sync = file.columns("/torque", ("time_s", "torque_nm", "sync"))
    if not time_s.size:
        raise file.bad("no torque sample", "/torque")
    _check_rising(file, time_s, "/torque/time_s")
    if time_s.size > 1:
        bounds.check_sampling(1 / float(np.median(np.diff(time_s))), f"{file.name}, /torque/time_s")
    code, names = _segments(file, time_s)
    inside = code >= 0
    if not inside.any():
        raise file.bad("no sample inside a segment", "/segments")
    if (bad := np.flatnonzero(inside & ~(np.abs(torque_nm) <= bounds.LARGEST["torque_nm"]))).size:
        what = "is not finite" if not np.isfinite(torque_nm[bad[0]]) else f"{torque_nm[bad[0]]:g} N·m is no measurement"
        raise BadRecord(f"torque {what}", place=f"{file.name}, /torque/torque_nm, sample {bad[0]}", fix=FIX)
    pulses, doubted = locate_pulses(_sent(file, 1.0 / rate), time_s, sync)
    width_us, late_s = in_force(pulses, time_s, rate)
    angles, unknown, note = _read_angle(file, time_s, inside)
    doubted = doubted | unknown
    bounds.check_span(time_s[inside], f"{file.name}, /torque/time_s")
    current_ma = file.number("current_ma", np.nan)
    columns: dict[str, Any] = {"time_s": time_s, "pulse_width_us": width_us, "torque_nm": torque_nm} | angles
    columns |= {"late_s": late_s} if pulses.late_s.any() else {}
    columns |= {"doubted": doubted} if doubted.any() else {}
    return Record.from_arrays(
        **{label: column[inside] for label, column in columns.items()},
        segment=code[inside],
        segment_names=names,
        pulses=pulses,
        pulse_rate_hz=rate,
        source=Source(
            name=path.name,
            recording_id=file.text("recording_id", ""),
            sha256=file.text("content_sha256", ""),
            notes=(note,) if note else (),
            participant=file.text("participant", ""),
            current_ma=current_ma if current_ma > 0.0 else None,
        ),
    )


def _open(content: bytes, path: Path) -> StrictFile:
    file = StrictFile(content, str(path))
    if file.text("format", "") != FORMAT:
        raise file.bad("HDF5, but no stimrig recording")
    if (version := file.number("format_version", 0)) != 1:
        message = f"format version {version:g}, this software reads 1"
        raise BadRecord(message, place=file.name, fix="Update the software.")
    return file


def _check_rising(file: StrictFile, time_s: np.ndarray, path: str) -> None:
    if (backwards := np.flatnonzero(~(np.diff(time_s) > 0))).size:
        raise file.bad("time runs backwards", f"{path}, sample {backwards[0] + 1}")
    if not (np.abs(time_s) <= bounds.LARGEST["time_s"]).all():
        raise file.bad("times that no clock shows", path)


def _sent(file: StrictFile, interval_s: float) -> Sent:
    names = ("planned_time_s", "sent_pulse_width_us", "written_time_s", "acknowledged_time_s", "status")
    planned_s, width_us, *host_s, status = file.columns("/pulses", names)
    width_us = np.where(np.isnan(width_us), 0.0, width_us)
    if (bad := np.flatnonzero(~((width_us >= 0) & (width_us <= bounds.LARGEST["pulse_width_us"])))).size:
        raise file.bad(f"{width_us[bad[0]]:g} µs is no pulse width", f"/pulses/sent_pulse_width_us, pulse {bad[0]}")
    if not (np.diff(planned_s) > 0).all() or not np.isfinite(planned_s).all():
        raise file.bad("pulses do not follow one another", "/pulses/planned_time_s")
    written_s, acknowledged_s = (np.where(np.abs(t) <= bounds.LARGEST["time_s"], t, np.nan) for t in host_s)
    return Sent(planned_s, width_us, written_s, acknowledged_s, status, interval_s)


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
    unknown = np.zeros(time_s.size, bool)
    if not file.has(GROUP):
        return {}, unknown, ""
    at_s, angle_rad, velocity_rad_s = file.columns(GROUP, ("time_s", "angle_rad", "velocity_rad_s"))
    _check_rising(file, at_s, f"{GROUP}/time_s")
    columns = {"angle_rad": angle_rad, "velocity_rad_s": velocity_rad_s}
    for label, values in columns.items():
        if (bad := np.flatnonzero(~(np.abs(values) <= bounds.LARGEST[label]))).size:
            raise file.bad(f"{label} {values[bad[0]]:g} is no measurement", f"{GROUP}/{label}, sample {bad[0]}")
    # Between two samples that are far apart, or farther from the first or the last.
    edges_s = np.r_[-np.inf, at_s, np.inf]
    after = np.searchsorted(edges_s, time_s)
    before_s, after_s = time_s - edges_s[after - 1], edges_s[after] - time_s
    within = np.isfinite(before_s + after_s)
    far = np.where(within, before_s + after_s, np.minimum(before_s, after_s)) > LONGEST_GAP_S
    unknown = far & (before_s > 0) & (after_s > 0)
    share = float(np.mean(unknown[inside]))
    if share > MOST_UNKNOWN:
        return {}, np.zeros(time_s.size, bool), f"no angle: the angle sensor gave none in {share:.0%} of the record"
    return {label: np.interp(time_s, at_s, values) for label, values in columns.items()}, unknown, ""
