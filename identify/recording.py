"""A record from a sealed recording (HDF5, docs/recording.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from identify.errors import BadRecord
from identify.record import Record, Source

FORMAT = "stimrig-recording"
SENT_AND_ACKNOWLEDGED = 0
MEND = "Give a sealed recording, as written by the rig at the end of a test."


def read_recording(path: Path, pulse_rate_hz: float | None = None) -> Record:
    """Read a sealed recording.

    The width in force at a sample is that of the last pulse due before it; a pulse that was dropped or refused counts
    as none. Samples outside every segment are left out.

    Raises
    ------
    BadRecord
        Unreadable, half-written, altered since it was sealed, or without samples.
    """
    import h5py

    name = str(path)
    try:
        with h5py.File(path, "r") as file:
            return _read(file, name, path.name, pulse_rate_hz)
    except OSError as error:
        raise BadRecord("unreadable or half-written HDF5", place=name, mend=MEND) from error
    except KeyError as error:
        missing = str(error.args[0]).replace('"', "").replace("'", "")
        raise BadRecord(f"incomplete recording ({missing})", place=name, mend=MEND) from error


def _read(file: Any, name: str, label: str, pulse_rate_hz: float | None) -> Record:
    if _text(file.attrs.get("format", "")) != FORMAT:
        raise BadRecord("HDF5, but no stimrig recording", place=name, mend=MEND)
    version = int(file.attrs.get("format_version", 0))
    if version != 1:
        raise BadRecord(f"format version {version}, this software reads 1", place=name, mend="Update the software.")
    time_s = np.asarray(file["/torque/time_s"][:], float)
    torque = np.asarray(file["/torque/torque_nm"][:], float)
    starts = np.asarray(file["/segments/start_s"][:], float)
    ends = np.asarray(file["/segments/end_s"][:], float)
    names = [_text(item) for item in file["/segments/name"][:]]
    rate = float(file.attrs.get("pulse_rate_hz", 40.0)) if pulse_rate_hz is None else pulse_rate_hz
    if time_s.size != torque.size or not time_s.size:
        raise BadRecord("no torque sample", place=f"{name}, /torque", mend=MEND)
    width = _held_width(file["/pulses"], time_s, rate)
    order = np.searchsorted(starts, time_s, side="right") - 1
    inside = (order >= 0) & (time_s < ends[np.maximum(order, 0)] + 1e-9)
    bad = np.flatnonzero(inside & ~np.isfinite(torque))
    if bad.size:
        raise BadRecord("torque is not finite", place=f"{name}, /torque/torque_nm, sample {bad[0]}", mend=MEND)
    backwards = np.flatnonzero(~(np.diff(time_s) > 0))
    if backwards.size:
        raise BadRecord("time runs backwards", place=f"{name}, /torque/time_s, sample {backwards[0] + 1}", mend=MEND)
    if not inside.any():
        raise BadRecord("no sample inside a segment", place=f"{name}, /segments", mend=MEND)
    return Record.from_arrays(
        time_s[inside],
        width[inside],
        torque[inside],
        np.array(names)[order[inside]],
        pulse_rate_hz=rate,
        source=Source(
            name=label,
            recording_id=_text(file.attrs.get("recording_id", "")),
            sha256=_text(file.attrs.get("content_sha256", "")),
        ),
    )


def _held_width(pulses: Any, time_s: np.ndarray, pulse_rate_hz: float) -> np.ndarray:
    """Width in force at each sample: pulses are put back on their even slots, late by what they were late together."""
    planned = np.asarray(pulses["planned_time_s"][:], float)
    sent = np.nan_to_num(np.asarray(pulses["sent_pulse_width_us"][:], float))
    written = np.asarray(pulses["written_time_s"][:], float)
    status = np.asarray(pulses["status"][:])
    if not planned.size:
        return np.zeros(time_s.size)
    sound = (status == SENT_AND_ACKNOWLEDGED) & np.isfinite(written)
    lag = float(np.median(written[sound] - planned[sound])) if sound.any() else 0.0
    slot = planned + lag
    last = np.searchsorted(slot, time_s + 1e-9, side="right") - 1
    width = np.where(last >= 0, sent[np.maximum(last, 0)], 0.0)
    # A slot without a pulse, at a gap or after the end, is no stimulation.
    return np.where(time_s - slot[np.maximum(last, 0)] < 1.5 / pulse_rate_hz, width, 0.0)


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
