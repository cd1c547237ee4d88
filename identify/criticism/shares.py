"""The error by segment, level of pulse width, direction, time and frequency, without doubted samples."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from identify.criticism.where import direction_of
from identify.dynamics.pulse_grid import runs
from identify.records.record import Record

LEVELS = 6
SPANS = 10
OCTAVES_HZ = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 102.4, 204.8, 409.6, 1000.0)


def _row(label: str, rows: np.ndarray, residual_nm: np.ndarray, noise_sd_nm: float, total: float) -> dict[str, Any]:
    """One row of a table: number of samples, error, mean, and share of the error above the noise."""
    values = residual_nm[rows]
    excess = float(np.sum(values**2) - values.size * noise_sd_nm**2)
    return {
        "label": label,
        "samples": int(values.size),
        "rms_nm": float(np.sqrt(np.mean(values**2))) if values.size else None,
        "mean_nm": float(np.mean(values)) if values.size else None,
        "share_of_excess": max(excess, 0.0) / total if total > 0 else 0.0,
    }


def _total(groups: list[np.ndarray], residual_nm: np.ndarray, noise_sd_nm: float) -> float:
    return sum(max(float(np.sum(residual_nm[g] ** 2) - g.sum() * noise_sd_nm**2), 0.0) for g in groups)


def _table(
    labels: list[str], groups: list[np.ndarray], residual: np.ndarray, noise: float, counted: np.ndarray | None
) -> list[dict[str, Any]]:
    groups = groups if counted is None else [group & counted for group in groups]
    total = _total(groups, residual, noise)
    return [
        _row(label, group, residual, noise, total) for label, group in zip(labels, groups, strict=True) if group.any()
    ]


def by_segment(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """By segment, in order."""
    groups = [record.segment == i for i in range(len(record.segment_names))]
    return _table(list(record.segment_names), groups, residual_nm, noise_sd_nm, counted)


def by_level(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """By pulse width: zero, then equal ranges up to the largest."""
    u, top = record.pulse_width_us, float(record.pulse_width_us.max())
    labels, groups = ["0 µs"], [u <= 0]
    edges = np.linspace(0.0, top, LEVELS + 1)
    for low, high in itertools.pairwise(edges):
        labels.append(f"{low:.0f}-{high:.0f} µs")
        groups.append((u > max(low, 0.0)) & (u <= high) if high > 0 else np.zeros(u.size, bool))
    return _table(labels, groups, residual_nm, noise_sd_nm, counted)


def by_direction(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """By direction: pulse width rising, falling or held over the last 0.3 s."""
    sign = direction_of(record)
    return _table(["rising", "falling", "held"], [sign > 0, sign < 0, sign == 0], residual_nm, noise_sd_nm, counted)


def by_time(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """By time: equal spans from the start."""
    t = record.time_s - record.time_s[0]
    edges = np.linspace(0.0, t[-1] + 1e-9, SPANS + 1)
    labels = [f"{a:.1f}-{b:.1f} s" for a, b in itertools.pairwise(edges)]
    groups = [(t >= a) & (t < b) for a, b in itertools.pairwise(edges)]
    return _table(labels, groups, residual_nm, noise_sd_nm, counted)


def by_frequency(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, counted: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """By octave: root mean square of the residual and of white noise in each."""
    rate = record.sample_rate_hz
    known = np.ones(residual_nm.size, bool) if counted is None else counted
    longest = max(runs(known), key=lambda r: r.stop - r.start)
    values = residual_nm[longest]
    power = np.abs(np.fft.rfft(values)) ** 2 / values.size**2
    power[1:] *= 2.0
    frequency = np.fft.rfftfreq(values.size, 1.0 / rate)
    rows = []
    for low, high in itertools.pairwise(OCTAVES_HZ):
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
