"""Pulse widths at times other than those of the samples that show them: by the slots in which pulses fall."""

from __future__ import annotations

import numpy as np

MOST_CHANGES = 2000
TRIALS = 400
EXPLAINED = 0.9
"""Share of the changes of width that one phase of the pulses must explain, or the pulses do not keep to the rate."""


def width_in_slots(
    time_s: np.ndarray, width_us: np.ndarray, at_s: np.ndarray, before: np.ndarray, pulse_rate_hz: float
) -> np.ndarray:
    """Pulse widths at `at_s`, shape (M,).

    A change of width that a sample shows came with a pulse between it and the sample before. Pulses keep to their rate:
    all changes together tell when they come, far more closely than one. Where they do not, the last sample's width
    stands.

    Parameters
    ----------
    time_s, width_us : ndarray, shape (N,)
        Samples, and the width in force at each.
    at_s : ndarray, shape (M,)
        Times that are asked for, rising.
    before : ndarray of int, shape (M,)
        The last sample at or before each.
    pulse_rate_hz : float
        Pulses a second.
    """
    phase_s = _phase_s(time_s, width_us, pulse_rate_hz)
    if phase_s is None:
        return width_us[before]
    hair = 1e-6

    def slot(moment_s: np.ndarray) -> np.ndarray:
        return np.floor((moment_s - phase_s) * pulse_rate_hz + hair)

    # The last sample that lies in the slot or before it.
    last = np.searchsorted(slot(time_s), slot(at_s), side="right") - 1
    return width_us[np.maximum(last, 0)]


def _phase_s(time_s: np.ndarray, width_us: np.ndarray, pulse_rate_hz: float) -> float | None:
    """When pulses come, modulo their interval, s: the latest phase that explains the most changes; None for none."""
    changes = np.flatnonzero(np.diff(width_us)) + 1
    if not changes.size:
        return None
    changes = changes[:: -(-changes.size // MOST_CHANGES)]
    step_s = 1.0 / pulse_rate_hz
    shown, unseen = np.mod(time_s[changes], step_s), time_s[changes] - time_s[changes - 1]
    trial = np.arange(TRIALS) * step_s / TRIALS
    explained = np.sum(np.mod(shown[:, None] - trial + 1e-9, step_s) < unseen[:, None], axis=0)
    if explained.max() < EXPLAINED * changes.size:
        return None
    best = float(trial[np.argmax(explained)])
    ahead = np.mod(shown - best + 1e-9, step_s)
    return best + float(np.min(ahead[ahead < unseen])) - 1e-9
