"""Several recordings of one participant as one record, for a verdict on all of them.

They are put one behind the other with the pause that was between them, as far as it is known and up to two minutes
(what has not recovered in them is not told from what does not recover): fatigue and drift go on in a pause, and a
joined record without it would show them wrong. Nothing is made up to fill it: it has no rows.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

HEADER = "time_s,pulse_width_us,torque_nm,segment"
PULSE_RATE_HZ = 40.0
"""A CSV file stands for this rate."""


LONGEST_PAUSE_S = 120.0
KNOWN_WITHOUT = ("late_s", "doubted")
"""Columns that a record lacks where there is nothing to tell."""
LEAST_PAUSE_S = 2.0
"""What a jump of the clock has to be for a reader to take it as a pause."""


def pauses(begun_s: Sequence[float | None], records: Sequence[Any]) -> list[float]:
    """Seconds between the end of each record and the begin of the next; 0 where it is not known."""
    found = []
    for earlier, later, record in zip(begun_s, begun_s[1:], records, strict=False):
        pause_s = 0.0 if earlier is None or later is None else later - earlier - float(record.time_s[-1])
        found.append(min(pause_s, LONGEST_PAUSE_S) if pause_s >= LEAST_PAUSE_S else 0.0)
    return found


def table(records: Sequence[Any], pause_s: Sequence[float] = ()) -> str:
    """The joined record as CSV, at the first one's sample rate; `pause_s` stands before the second, the third, …

    Raises
    ------
    identify.BadRecord
        Pulse rates differ from 40 pulses/s, or a part does not begin at rest.
    """
    import numpy as np

    rate_hz = float(records[0].sample_rate_hz)
    columns: list[tuple[Any, Any, Any]] = []
    also: list[dict[str, Any]] = []
    for number, record in enumerate(records, start=1):
        check(record, number)
        columns.append(resampled(record, rate_hz))
        also.append(beside(record, rate_hz))
    width, torque, names = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    time_s = np.arange(width.size) / rate_hz
    ends = np.cumsum([part[0].size for part in columns])
    for end, pause in zip(ends[:-1], pause_s, strict=False):
        time_s[end:] += np.round(pause * PULSE_RATE_HZ) / PULSE_RATE_HZ
    more = joined_columns(also)
    text = io.StringIO(newline="")
    text.write(",".join([HEADER, *more]) + "\n")
    rows = csv.writer(text, lineterminator="\n")
    for seconds, width_us, torque_nm, name, *rest in zip(time_s, width, torque, names, *more.values(), strict=True):
        values = [f"{value:.6g}" for value in rest]
        rows.writerow([f"{seconds:.6f}", f"{width_us:g}", f"{torque_nm:.6f}", name, *values])
    return text.getvalue()


def joined_columns(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The optional columns of all parts: of angle and velocity those that every part has, of the others any."""
    import numpy as np

    names = [name for name in parts[0] if all(name in part for part in parts)]
    found = {name: np.concatenate([part[name] for part in parts]) for name in names}
    return {name: column for name, column in found.items() if name not in KNOWN_WITHOUT or column.any()}


def check(record: Any, number: int) -> None:
    """Refuse a part that cannot be joined."""
    import identify

    if abs(record.pulse_rate_hz - PULSE_RATE_HZ) > 1e-6:
        message = f"{record.pulse_rate_hz:g} pulses/s; recordings are joined at {PULSE_RATE_HZ:g} only"
        raise identify.BadRecord(message, place=f"recording {number}")
    if number > 1 and record.pulse_width_us[: max(1, round(0.1 * record.sample_rate_hz))].any():
        mend = "Begin the test with a rest."
        raise identify.BadRecord("it does not begin at rest", place=f"recording {number}", mend=mend)


def resampled(record: Any, rate_hz: float) -> tuple[Any, Any, Any]:
    """Pulse width, torque, segment names at another rate, beginning with the slot of a pulse.

    Torque is averaged over a new sample's span where the rate falls, and interpolated where it does not.
    """
    import numpy as np

    time_s, last = _places(record, rate_hz)
    own_hz = float(record.sample_rate_hz)
    torque = record.torque_nm
    if own_hz > 1.5 * rate_hz:
        span = max(1, round(own_hz / rate_hz))
        torque = np.convolve(torque, np.ones(span) / span, "same")
    names = np.array(record.segment_names, dtype=object)[record.segment[last]]
    width = record.pulse_width_us[last]
    if record.pulses is not None and record.pulses.time_s.size:  # where samples are missing the pulses tell
        slot = np.clip(np.searchsorted(record.pulses.time_s, time_s + 1e-9, side="right") - 1, 0, None)
        width = np.where(time_s - record.time_s[last] > 1.0 / PULSE_RATE_HZ, record.pulses.width_us[slot], width)
    return width, np.interp(time_s, record.time_s, torque), names


def beside(record: Any, rate_hz: float) -> dict[str, Any]:
    """The optional columns at another rate, as `resampled`; lateness and doubt always, where none is told as none.

    Samples that are missing were not measured: `resampled` draws a line there, and its rows are doubted.
    """
    import numpy as np

    from identify.records.record import FORGOTTEN_S

    time_s, last = _places(record, rate_hz)
    own = record.columns()
    found = {name: np.interp(time_s, record.time_s, own[name]) for name in own if name not in KNOWN_WITHOUT}
    late_s, doubted = (own.get(name, np.zeros(record.time_s.size))[last].astype(float) for name in KNOWN_WITHOUT)
    away_s = time_s - record.time_s[last]
    missing = away_s > 1.0 / PULSE_RATE_HZ
    doubted[missing] = 1.0
    if record.pulses is None:  # nobody knows what was applied meanwhile
        told = record.pulse_width_us[last] > 0
        for end in np.flatnonzero(missing[:-1] & ~missing[1:]) + 1:
            if told[end - 1] or told[end]:
                doubted[end : end + round(FORGOTTEN_S * rate_hz)] = 1.0
    return {**found, "late_s": late_s, "doubted": doubted}


def _places(record: Any, rate_hz: float) -> tuple[Any, Any]:
    """The new samples' times, beginning with the slot of a pulse, and the last of the record's own before each."""
    import numpy as np

    start_s = first_slot_s(record)
    count = int(np.floor((record.time_s[-1] - start_s) * rate_hz + 1e-6)) + 1
    per_slot = rate_hz / PULSE_RATE_HZ
    count = int(np.floor(count / per_slot) * per_slot)
    time_s = start_s + np.arange(count) / rate_hz
    own_hz = float(record.sample_rate_hz)
    return time_s, np.clip(np.searchsorted(record.time_s, time_s + 0.25 / own_hz, side="right") - 1, 0, None)


def first_slot_s(record: Any) -> float:
    """The first time in the record at which a pulse is due, from the first change of the pulse width."""
    import numpy as np

    changes = np.flatnonzero(np.diff(record.pulse_width_us)) + 1
    if not changes.size:
        return float(record.time_s[0])
    change_s = float(record.time_s[changes[0]])
    slots = np.floor((change_s - record.time_s[0]) * PULSE_RATE_HZ + 1e-6)
    return change_s - float(slots) / PULSE_RATE_HZ
