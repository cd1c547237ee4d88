"""A record from a sealed recording (HDF5, docs/recording.md): when each pulse came, and what of it is not known.

A busy host writes pulses late, reads their acknowledgements late, and drops some. The stimulator's sync line, where the
load cell records it, shows each pulse in the very sample after it. Without one a pulse came somewhere between its
writing and its acknowledgement: the middle is taken, and a pulse for which they lie far apart is doubted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.hdf5 import FIX, StrictFile
from stimrig.identify.records.record import FORGOTTEN_S, Pulses, Record, Source

SENT_AND_ACKNOWLEDGED, DROPPED, REFUSED = 0, 2, 3
PROMPT = 0.05
"""Lateness counts from this quantile of a recording's pulses: a lag that all share is a delay, which the fit finds."""
LEAST_LATE_S = 1e-3
"""Less is jitter of the clocks and moves torque by less than any cell's noise."""
LONGEST_LATE_S = bounds.LARGEST["late_s"]
"""More is a clock gone wrong: the pulse is doubted."""
UNSURE = 0.5
"""Of a pulse interval: one that may have been felt as far off may as well have been felt in another's place."""
SYNC_SHARE = 0.9
"""So many of the acknowledged pulses must show on the sync line, and so few edges be left over, for it to be believed.

A line that is not connected, or that means something else, shows few; a rig that loses pulses on their way still most.
"""
REACH = 0.25
"""Of a pulse interval: so far outside of writing and acknowledgement an edge is still its pulse's (clocks differ)."""


@dataclass(frozen=True)
class _Sent:
    """What the host knows: times of all planned pulses, s, NaN where there is none."""

    planned: np.ndarray
    width: np.ndarray
    written: np.ndarray
    acknowledged: np.ndarray
    status: np.ndarray
    interval_s: float

    @property
    def sound(self) -> np.ndarray:
        return (self.status == SENT_AND_ACKNOWLEDGED) & np.isfinite(self.written)


def read_pulses(file: StrictFile, time_s: np.ndarray, pulse_rate_hz: float) -> tuple[Pulses, np.ndarray]:
    """The pulses on their even slots with what they were late, and the samples that are doubted, bool, (N,).

    Raises BadRecord: columns of different lengths, no widths, or out of order.
    """
    sent = _sent(file, 1.0 / pulse_rate_hz)
    if not sent.planned.size:
        nothing = np.zeros(0)
        return Pulses(nothing, nothing, nothing, np.zeros(0, bool)), np.zeros(time_s.size, bool)
    sync = file.numbers("/torque/sync") if file.has("/torque/sync") else np.full(time_s.size, 255.0)
    if sync.size != time_s.size:
        raise file.bad("columns of different lengths", "/torque/sync")
    sound = sent.sound
    # Even slots, late by what the promptest pulses were late together.
    lag = float(np.quantile((sent.written - sent.planned)[sound], PROMPT)) if sound.any() else 0.0
    late, unsure, extra_s = _pulse_lateness(sent, time_s, sync)
    may = sent.width > 0
    wild = ~(np.abs(late) <= LONGEST_LATE_S)
    unsure = may & (unsure | wild)
    late = np.where(may & ~wild & (np.abs(late) >= LEAST_LATE_S), late, 0.0)
    slot = sent.planned + lag
    # An acknowledgement that came late tells by when the pulse was felt at the latest.
    latest = _by(sent.acknowledged, slot)[unsure]
    lost = np.isin(sent.status, (DROPPED, REFUSED))
    spans = np.r_[slot[unsure], extra_s], np.r_[latest, extra_s] + FORGOTTEN_S
    return Pulses(slot, sent.width, late, lost), _inside(time_s, *spans)


def _sent(file: StrictFile, interval_s: float) -> _Sent:
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
    return _Sent(planned, sent, written, acknowledged, status, interval_s)


def _pulse_lateness(sent: _Sent, time_s: np.ndarray, sync: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lateness of each pulse behind the promptest, s; whether it is unsure; times of pulses that nobody asked for."""
    late, unsure = _host_lateness(sent)
    seen = _edges(time_s, sync)
    found = None if seen is None else _matched(sent, *seen)
    if seen is None or found is None:
        return late, unsure, np.zeros(0)
    edge, extra_s = found
    shown = edge >= 0
    earliest, newest = (side[np.maximum(edge, 0)] for side in seen)
    # The line tells the sample, the host's clock where in it.
    shift = float(np.median((0.5 * (earliest + newest) - sent.written)[shown]))
    felt = np.clip(sent.written + shift, earliest, newest)
    prompt = shown & sent.sound
    base = float(np.quantile((felt - sent.planned)[prompt], PROMPT))
    # Where the cell lost samples the line shows nothing, and the host's word stands.
    watched = _watched(sent, time_s)
    late = np.where(shown, felt - sent.planned - base, late)
    return late, np.where(shown, False, unsure | watched), extra_s


def _host_lateness(sent: _Sent) -> tuple[np.ndarray, np.ndarray]:
    """Lateness and doubt by writing and acknowledgement alone."""
    sound = sent.sound & np.isfinite(sent.acknowledged)
    middle = 0.5 * (sent.written + sent.acknowledged)
    if not sound.any():
        return np.zeros(sent.planned.size), ~sent.sound
    late = middle - sent.planned
    late = late - float(np.quantile(late[sound], PROMPT))
    span = sent.acknowledged - sent.written
    usual = float(np.quantile(span[sound], PROMPT))
    unsure = ~sound | (span - usual > UNSURE * sent.interval_s)
    return np.where(sound, late, 0.0), unsure


def _edges(time_s: np.ndarray, sync: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """For each pulse on the sync line the last sample without it and the first with it, s; None without a line."""
    if time_s.size < 2 or not np.any(sync == 1):
        return None
    period_s = float(np.median(np.diff(time_s)))
    rising = np.flatnonzero((sync[1:] == 1) & (sync[:-1] == 0) & (np.diff(time_s) < 1.5 * period_s))
    return (time_s[rising], time_s[rising + 1]) if rising.size else None


def _matched(sent: _Sent, earliest: np.ndarray, newest: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """For each pulse its edge, −1 for none, and the times of edges left over; None where the line is not believed."""
    may = (sent.width > 0) & np.isfinite(sent.written)
    reach_s = REACH * sent.interval_s
    centre = 0.5 * (earliest + newest)
    start = np.where(may, sent.written, -np.inf) - reach_s
    stop = np.where(np.isfinite(sent.acknowledged), sent.acknowledged, sent.written + sent.interval_s) + reach_s
    after = np.searchsorted(centre, start)
    place = np.minimum(after, centre.size - 1)
    good = may & (after < centre.size) & (centre[place] <= stop)
    edge = np.full(place.size, -1)
    found, first = np.unique(np.where(good, place, -1), return_index=True)
    edge[first] = found  # an edge is that of the first pulse that can have made it
    left = np.setdiff1d(np.arange(centre.size), edge)
    asked = int(np.sum(may & sent.sound))
    shown = int(np.sum((edge >= 0) & sent.sound))
    if not asked or shown < SYNC_SHARE * asked or left.size > (1 - SYNC_SHARE) * asked:
        return None
    return edge, newest[left]


def _by(acknowledged_s: np.ndarray, begin_s: np.ndarray) -> np.ndarray:
    """When a pulse was felt at the latest, s; its begin where it was not acknowledged."""
    known = np.isfinite(acknowledged_s)
    return np.where(known, np.clip(acknowledged_s, begin_s, begin_s + LONGEST_LATE_S), begin_s)


def _watched(sent: _Sent, time_s: np.ndarray) -> np.ndarray:
    """Whether the cell sampled all the while in which a pulse can have been felt."""
    period_s = float(np.median(np.diff(time_s)))
    holes = np.flatnonzero(np.diff(time_s) >= 1.5 * period_s)
    start = np.where(np.isfinite(sent.written), sent.written, sent.planned)
    stop = _by(sent.acknowledged, start) + REACH * sent.interval_s
    start = start - REACH * sent.interval_s
    # The first hole that ends after the start must begin after the stop.
    after = np.searchsorted(time_s[holes + 1], start, side="right")
    begins = np.r_[time_s[holes], np.inf][after]
    return (begins >= stop) & (start >= time_s[0]) & (stop <= time_s[-1])


def _inside(time_s: np.ndarray, starts_s: np.ndarray, ends_s: np.ndarray) -> np.ndarray:
    """Samples within any of the spans."""
    depth = np.zeros(time_s.size + 1, np.int64)
    np.add.at(depth, np.searchsorted(time_s, starts_s - 1e-9), 1)
    np.add.at(depth, np.searchsorted(time_s, ends_s + 1e-9), -1)
    return np.cumsum(depth[:-1]) > 0


FORMAT = "stimrig-recording"
LONGEST_GAP_S = 0.05
"""Between two angles that are farther apart it is not known where the joint was."""
MOST_UNKNOWN = 0.5
"""With more rows than this without an angle the sensor failed, and the record has no angle."""
GROUP = "/angle"


def attributes(path: Path, names: Sequence[str]) -> dict[str, str]:
    """What a sealed recording says of itself, by the names of its root's attributes.

    Raises BadRecord: unreadable, no sealed recording, or one of them is not there.
    """
    file = StrictFile(bounds.content_of(path), str(path))
    _check_format(file)
    return {name: file.text(name) for name in names}


def read_recording(content: bytes, path: Path, pulse_rate_hz: float | None = None) -> Record:
    """A sealed recording from its bytes; `path` is how it is called.

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
    pulses, doubts = read_pulses(file, time_s, rate)
    width, late = _in_force(pulses, time_s, rate)
    angles, unknown, note = _read_angle(file, time_s, inside)
    doubts = doubts | unknown
    bounds.check_span(time_s[inside], f"{file.name}, /torque/time_s")
    identity, digest, whose = (file.text(key, "") for key in ("recording_id", "content_sha256", "participant"))
    current_ma = file.number("current_ma", np.nan)
    columns: dict[str, Any] = {"time_s": time_s, "pulse_width_us": width, "torque_nm": torque} | angles
    columns |= {"late_s": late} if pulses.late_s.any() else {}
    columns |= {"doubted": doubts} if doubts.any() else {}
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
            participant=whose,
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
    for index, text in enumerate(names):
        bounds.check_name(text, f"{file.name}, /segments/name, segment {index}")
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
