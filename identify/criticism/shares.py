"""The error by segment, level of pulse width, direction, time and frequency, without doubted samples."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.criticism.where import direction_of
from stimrig.identify.dynamics.grid import runs
from stimrig.identify.records.record import Record

LEVELS = 6
SPANS = 10
OCTAVES_HZ = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 102.4, 204.8, 409.6, 1000.0)
Groups = list[tuple[str, np.ndarray]]
"""Labels and rows, bool, shape (N,)."""


def error_shares(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray
) -> dict[str, list[dict[str, Any]]]:
    """What `Comparison.by` holds.

    Parameters
    ----------
    record : Record
        The measurement.
    residual_nm : ndarray, shape (N,)
        Measurement minus model, N·m.
    noise_sd_nm : float
        White noise of a sample, N·m.
    counted : ndarray of bool, shape (N,)
        Samples that count.
    """
    sign = direction_of(record)
    kinds: dict[str, Groups] = {
        "segment": [(name, record.segment == i) for i, name in enumerate(record.segment_names)],
        "level": _levels(record.pulse_width_us),
        "direction": [("rising", sign > 0), ("falling", sign < 0), ("held", sign == 0)],
        "time": _spans(record.time_s - record.time_s[0]),
    }
    tables = {kind: _table(groups, residual_nm, noise_sd_nm, counted) for kind, groups in kinds.items()}
    return tables | {"frequency": _by_frequency(record.sample_rate_hz, residual_nm, noise_sd_nm, counted)}


def _levels(width_us: np.ndarray) -> Groups:
    """Zero, then equal ranges up to the largest width."""
    found = [("0 µs", width_us <= 0)]
    for low, high in pairwise(np.linspace(0.0, float(width_us.max()), LEVELS + 1)):
        rows = (width_us > max(low, 0.0)) & (width_us <= high) if high > 0 else np.zeros(width_us.size, bool)
        found.append((f"{low:.0f}-{high:.0f} µs", rows))
    return found


def _spans(time_s: np.ndarray) -> Groups:
    """Equal spans from the start."""
    edges = np.linspace(0.0, time_s[-1] + 1e-9, SPANS + 1)
    return [(f"{a:.1f}-{b:.1f} s", (time_s >= a) & (time_s < b)) for a, b in pairwise(edges)]


def _table(groups: Groups, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray) -> list[dict[str, Any]]:
    """For each group that counts: number of samples, error, mean, and share of the error above the noise."""
    parts = [(label, residual_nm[rows & counted]) for label, rows in groups]
    excess = [max(float(np.sum(values**2) - values.size * noise_sd_nm**2), 0.0) for _, values in parts]
    total = sum(excess)
    return [
        {
            "label": label,
            "samples": int(values.size),
            "rms_nm": float(np.sqrt(np.mean(values**2))),
            "mean_nm": float(np.mean(values)),
            "share_of_excess": own / total if total > 0 else 0.0,
        }
        for (label, values), own in zip(parts, excess, strict=True)
        if values.size
    ]


def _by_frequency(
    rate: float, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray
) -> list[dict[str, Any]]:
    """By octave: root mean square of the residual and of white noise in each."""
    longest = max(runs(counted), key=lambda r: r.stop - r.start)
    values = residual_nm[longest]
    power = np.abs(np.fft.rfft(values)) ** 2 / values.size**2
    power[1:] *= 2.0
    frequency = np.fft.rfftfreq(values.size, 1.0 / rate)
    rows = []
    for low, high in pairwise(OCTAVES_HZ):
        inside = (frequency >= low) & (frequency < high)
        if not inside.any() or low >= rate / 2:
            continue
        noise = noise_sd_nm * float(np.sqrt(inside.sum() / frequency.size))
        rows.append(
            {
                "label": f"{low:g}-{min(high, rate / 2):g} Hz",
                "from_hz": low,
                "to_hz": min(high, rate / 2),
                "rms_nm": float(np.sqrt(power[inside].sum())),
                "noise_nm": noise,
            }
        )
    excess = [max(row["rms_nm"] ** 2 - row["noise_nm"] ** 2, 0.0) for row in rows]
    total = sum(excess)
    for row, value in zip(rows, excess, strict=True):
        row["share_of_excess"] = value / total if total > 0 else 0.0
    return rows
