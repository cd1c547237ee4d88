"""The places of the largest error, named by segment, pulse width and direction."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.records.record import Record

STRETCH_S = 0.5
MOST = 5
"""Largest number of places."""


def direction_of(record: Record) -> np.ndarray:
    """+1 where the pulse width rose over the last 0.3 s, -1 where it fell, 0 where it was held; shape (N,)."""
    u = record.pulse_width_us
    back = max(round(0.3 * record.sample_rate_hz), 1)
    change = u - np.r_[np.full(back, u[0]), u[:-back]]
    level = 0.004 * max(float(u.max()), 1.0)
    return np.where(change > level, 1, np.where(change < -level, -1, 0))


def worst_places(
    record: Record, residual_nm: np.ndarray, noise_sd_nm: float, *, rows: np.ndarray
) -> list[dict[str, Any]]:
    """The stretches with most of the error above the noise.

    Parameters
    ----------
    record : Record
        The measurement.
    residual_nm : ndarray, shape (N,)
        Measurement minus model, N·m.
    noise_sd_nm : float
        White noise of a sample, N·m.
    rows : ndarray of bool, shape (N,)
        Rows to examine.

    Returns
    -------
    list of dict
        As `where` in `diagnose --json`, worst first, with `mean_error_nm` (positive: the model is too low) and `text`.
    """
    length = max(round(STRETCH_S * record.sample_rate_hz), 1)
    rising = direction_of(record)
    excess_total, pieces = 0.0, []
    for run in np.split(np.arange(record.time_s.size), np.flatnonzero(np.diff(record.segment)) + 1):
        for start in range(int(run[0]), int(run[-1]) + 1, length):
            stop = min(start + length, int(run[-1]) + 1)
            take = np.arange(start, stop)[rows[start:stop]]
            if take.size < 2:
                continue
            excess = float(np.sum(residual_nm[take] ** 2) - take.size * noise_sd_nm**2)
            excess_total += max(excess, 0.0)
            pieces.append([start, stop, excess, int(np.sign(np.sum(rising[take])))])
    if excess_total <= 0.0:
        return []
    merged = sorted(_merge(pieces, record), key=lambda piece: -piece[2])
    return [
        _place(record, residual_nm, rows, piece, excess_total)
        for piece in merged[:MOST]
        if piece[2] > 0.02 * excess_total
    ]


def _merge(pieces: list[list[Any]], record: Record) -> list[list[Any]]:
    """Join neighbouring stretches of the same segment and direction, if each has much of the error."""
    level = 0.3 * max(piece[2] / (piece[1] - piece[0]) for piece in pieces)
    result: list[list[Any]] = []
    for piece in pieces:
        strong = piece[2] / (piece[1] - piece[0]) > level
        last = result[-1] if result else None
        if (
            last is not None
            and strong
            and last[4]
            and last[1] == piece[0]
            and last[3] == piece[3]
            and record.segment[last[0]] == record.segment[piece[0]]
        ):
            last[1], last[2] = piece[1], last[2] + piece[2]
        else:
            result.append([*piece, strong])
    return result


def _place(record: Record, residual_nm: np.ndarray, rows: np.ndarray, piece: list[Any], total: float) -> dict[str, Any]:
    start, stop, excess, sign = piece[:4]
    name = record.segment_names[int(record.segment[start])]
    widths = record.pulse_width_us[start:stop]
    looked_at = residual_nm[start:stop][rows[start:stop]]
    error = float(np.mean(looked_at))
    direction = {1: "rising", -1: "falling", 0: "held"}[sign]
    share = excess / total
    return {
        "segment": name,
        "start_s": float(record.time_s[start]),
        "end_s": float(record.time_s[stop - 1]),
        "pulse_width_us": [float(widths.min()), float(widths.max())],
        "direction": direction,
        "share_of_excess": float(share),
        "mean_error_nm": error,
        "text": _words(name, widths, direction, error, float(np.sqrt(np.mean(looked_at**2))), share),
    }


def _words(name: str, widths: np.ndarray, direction: str, error: float, size: float, share: float) -> str:
    low, high = float(widths.min()), float(widths.max())
    span = f"{low:.0f} µs" if high - low < 0.5 else f"{low:.0f}-{high:.0f} µs"
    part = name if direction == "held" else f"{direction} {name}"
    if abs(error) > 0.6 * size:
        what = f"model too {'low' if error > 0 else 'high'} by {abs(error):.2g} N·m"
    else:
        what = f"error of {size:.2g} N·m in both directions"
    return f"{part}, {span}: {what}, {100 * share:.0f} % of the error above the noise"
