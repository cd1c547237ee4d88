"""Pulses as they were felt, not as they were planned: when each came, and what of it is not known.

A busy host writes pulses late, reads their acknowledgements late, and drops some; in a pause it sends none. The
stimulator's sync line, where the load cell records it, shows each pulse in the very sample after it. Without one a
pulse came somewhere between its writing and its acknowledgement: the middle is taken, and a pulse for which they lie
far apart is doubted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.records import bounds
from stimrig.identify.records.record import FORGOTTEN_S, Pulses

SENT_AND_ACKNOWLEDGED, RESTS, DROPPED, REFUSED, ON_ITS_WAY = range(5)
"""Outcome of a pulse, `/pulses/status` of a recording."""
PROMPT = 0.05
"""Lateness counts from this quantile of a recording's pulses: a lag that all share is a delay, which the fit finds."""
LEAST_LATE_S = 1e-3
"""Less is jitter of the clocks and moves torque by less than any cell's noise."""
LONGEST_LATE_S = bounds.LARGEST["late_s"]
"""More is a clock gone wrong: the pulse is doubted."""
UNSURE = 0.5
"""Share of a pulse interval; a pulse with a larger uncertainty may belong to the next interval."""
SYNC_SHARE = 0.9
"""So many of the acknowledged pulses must show on the sync line, and so few edges be left over, for it to be believed.

A line that is not connected, or that means something else, shows few; a rig that loses pulses on their way still most.
"""
REACH = 0.25
"""Share of a pulse interval by which an edge may lie outside of writing and acknowledgement (clocks differ)."""


@dataclass(frozen=True)
class Sent:
    """All planned pulses as the host logged them, shape (P,): times in s, NaN where there is none; widths, 0: none."""

    planned_s: np.ndarray
    width_us: np.ndarray
    written_s: np.ndarray
    acknowledged_s: np.ndarray
    status: np.ndarray
    interval_s: float

    @property
    def sound(self) -> np.ndarray:
        return (self.status == SENT_AND_ACKNOWLEDGED) & np.isfinite(self.written_s)


def locate_pulses(sent: Sent, time_s: np.ndarray, sync: np.ndarray) -> tuple[Pulses, np.ndarray]:
    """The pulses on their even slots with what they were late, and the samples that are doubted, bool, (N,).

    `sent`: what the host knows of them; may be none. `time_s`, `sync`: shape (N,); of the samples: when they were
    taken, on the clock of the pulses, and the sync line (1: a pulse; 255: no line).
    """
    if not sent.planned_s.size:
        nothing = np.zeros(0)
        return Pulses(nothing, nothing, nothing, np.zeros(0, bool)), np.zeros(time_s.size, bool)
    sound = sent.sound
    # Even slots, late by what the promptest pulses were late together.
    lag = float(np.quantile((sent.written_s - sent.planned_s)[sound], PROMPT)) if sound.any() else 0.0
    late, unsure, extra_s = _lateness(sent, time_s, sync)
    may = sent.width_us > 0
    wild = ~(np.abs(late) <= LONGEST_LATE_S)
    unsure = may & (unsure | wild)
    late = np.where(may & ~wild & (np.abs(late) >= LEAST_LATE_S), late, 0.0)
    slot = sent.planned_s + lag
    # A late acknowledgement bounds the time at which the pulse was felt.
    latest = _by(sent.acknowledged_s, slot)[unsure]
    lost = np.isin(sent.status, (DROPPED, REFUSED))
    spans = np.r_[slot[unsure], extra_s], np.r_[latest, extra_s] + FORGOTTEN_S
    return Pulses(slot, sent.width_us, late, lost), _inside(time_s, *spans)


def _lateness(sent: Sent, time_s: np.ndarray, sync: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lateness of each pulse behind the promptest, s; whether it is unsure; times of unplanned pulses."""
    known = sent.sound & np.isfinite(sent.acknowledged_s)
    late, unsure = np.zeros(sent.planned_s.size), ~sent.sound
    if known.any():
        middle_s, span_s = 0.5 * (sent.written_s + sent.acknowledged_s), sent.acknowledged_s - sent.written_s
        late_s, usual_s = (float(np.quantile(x[known], PROMPT)) for x in (middle_s - sent.planned_s, span_s))
        late = np.where(known, middle_s - sent.planned_s - late_s, 0.0)
        unsure = ~known | (span_s - usual_s > UNSURE * sent.interval_s)
    period_s = float(np.median(np.diff(time_s))) if time_s.size > 1 else np.inf
    rising = np.flatnonzero((sync[1:] == 1) & (sync[:-1] == 0) & (np.diff(time_s) < 1.5 * period_s))
    # Of each pulse on the sync line the last sample without it and the first with it.
    earliest_s, newest_s = time_s[rising], time_s[rising + 1]
    edge, extra_s = _matched(sent, earliest_s, newest_s)
    if edge is None:
        return late, unsure, extra_s
    on_line = edge >= 0
    earliest_s, newest_s = earliest_s[edge], newest_s[edge]
    # The line gives the sample, the host's clock the time within it.
    shift_s = float(np.median((0.5 * (earliest_s + newest_s) - sent.written_s)[on_line]))
    late_s = np.clip(sent.written_s + shift_s, earliest_s, newest_s) - sent.planned_s
    late_s -= float(np.quantile(late_s[on_line & sent.sound], PROMPT))
    # Where the cell lost samples the line shows nothing, and the host's times are used.
    unsure = unsure | _watched(sent, time_s, period_s)
    return np.where(on_line, late_s, late), np.where(on_line, False, unsure), extra_s


def _matched(sent: Sent, earliest: np.ndarray, newest: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """For each pulse its edge, −1 for none, and the times of edges left over; None where the line is not believed."""
    nothing = None, np.zeros(0)
    if not newest.size:
        return nothing
    may = (sent.width_us > 0) & np.isfinite(sent.written_s)
    reach_s = REACH * sent.interval_s
    centre = 0.5 * (earliest + newest)
    start = np.where(may, sent.written_s, -np.inf) - reach_s
    stop = np.where(np.isfinite(sent.acknowledged_s), sent.acknowledged_s, sent.written_s + sent.interval_s) + reach_s
    after = np.searchsorted(centre, start)
    place = np.minimum(after, centre.size - 1)
    good = may & (after < centre.size) & (centre[place] <= stop)
    edge = np.full(place.size, -1)
    edge_index, first = np.unique(np.where(good, place, -1), return_index=True)
    edge[first] = edge_index  # an edge is that of the first pulse that can have made it
    unmatched = np.setdiff1d(np.arange(centre.size), edge)
    expected = int(np.sum(may & sent.sound))
    matched = int(np.sum((edge >= 0) & sent.sound))
    if not expected or matched < SYNC_SHARE * expected or unmatched.size > (1 - SYNC_SHARE) * expected:
        return nothing
    return edge, newest[unmatched]


def _by(acknowledged_s: np.ndarray, begin_s: np.ndarray) -> np.ndarray:
    """Latest time at which a pulse was felt, s; its begin where it was not acknowledged."""
    known = np.isfinite(acknowledged_s)
    return np.where(known, np.clip(acknowledged_s, begin_s, begin_s + LONGEST_LATE_S), begin_s)


def _watched(sent: Sent, time_s: np.ndarray, period_s: float) -> np.ndarray:
    """bool, shape (P,): pulses during whose possible time the cell lost no sample."""
    holes = np.flatnonzero(np.diff(time_s) >= 1.5 * period_s)
    start = np.where(np.isfinite(sent.written_s), sent.written_s, sent.planned_s)
    stop = _by(sent.acknowledged_s, start) + REACH * sent.interval_s
    start = start - REACH * sent.interval_s
    # The first hole that ends after the start must begin after the stop.
    after = np.searchsorted(time_s[holes + 1], start, side="right")
    begins = np.r_[time_s[holes], np.inf][after]
    return (begins >= stop) & (start >= time_s[0]) & (stop <= time_s[-1])


def _inside(time_s: np.ndarray, starts_s: np.ndarray, ends_s: np.ndarray) -> np.ndarray:
    depth = np.zeros(time_s.size + 1, np.int64)
    np.add.at(depth, np.searchsorted(time_s, starts_s - 1e-9), 1)
    np.add.at(depth, np.searchsorted(time_s, ends_s + 1e-9), -1)
    return np.cumsum(depth[:-1]) > 0


def in_force(pulses: Pulses, time_s: np.ndarray, pulse_rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Width and lateness of the pulse in force at each sample, by the even slots."""
    if not pulses.time_s.size:
        return np.zeros(time_s.size), np.zeros(time_s.size)
    last = np.searchsorted(pulses.time_s, time_s + 1e-9, side="right") - 1
    # A slot without a pulse, at a gap or after the end, is no stimulation.
    inside = (last >= 0) & (time_s - pulses.time_s[np.maximum(last, 0)] < 1.5 / pulse_rate_hz)
    last = np.maximum(last, 0)
    return np.where(inside, pulses.width_us[last], 0.0), np.where(inside, pulses.late_s[last], 0.0)
