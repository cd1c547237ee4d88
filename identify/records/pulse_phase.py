"""Where between two samples the pulses of a record fall."""

from __future__ import annotations

import numpy as np

from stimrig.identify.records.record import Record

NEARLY = 0.9
"""Share of the pulse interval from which a sample is nearly as long."""


def pulse_phase_s(record: Record) -> float:
    """Time of the pulse slots after the first sample, modulo the pulse interval, s.

    A change of width seen first in the sample at t puts a pulse into (t - 1/rate, t]. The phase that satisfies the
    most changes is taken; of those, the latest (the pulse coincides with the sample that shows it).
    """
    changes = np.flatnonzero(np.diff(record.pulse_width_us)) + 1
    step_s, sample_s = 1.0 / record.pulse_rate_hz, 1.0 / record.sample_rate_hz
    if changes.size == 0 or sample_s > 0.999 * step_s:
        return 0.0
    latest = np.mod(record.time_s[changes] - record.time_s[0], step_s)
    latest, often = np.unique(np.round(latest, 9), return_counts=True)
    if sample_s > NEARLY * step_s:
        # Any phase but a sliver is explained by all changes: the sliver tells. It is the widest without a change.
        gaps = np.diff(np.r_[latest, latest[0] + step_s])
        widest = int(np.argmax(gaps))
        first = latest[(widest + 1) % latest.size]
        return (
            0.0
            if gaps[widest] < 0.5 * (step_s - sample_s) or min(first, step_s - first) < 1e-3 * step_s
            else float(first)
        )
    trial = np.linspace(0.0, step_s, 401)[:-1]
    # How many changes each trial phase explains, with a tolerance of a hair for rounding.
    lag = np.mod(latest[:, None] - trial[None, :] + 1e-3 * sample_s, step_s)
    explained = often @ (lag < sample_s * 1.002)
    best = np.flatnonzero(explained == explained.max())
    anchor = trial[best[best.size // 2]]
    # From the anchor the earliest 'latest' time is the bound; take it exactly, free of the trial's spacing.
    ahead = np.mod(latest - anchor + 1e-3 * sample_s, step_s)
    inside = ahead[ahead < sample_s * 1.002]
    phase = float(np.mod(anchor + np.min(inside) - 1e-3 * sample_s, step_s))
    return 0.0 if step_s - phase < 1e-9 else phase
