"""What a slow ramp says of the recruitment curve on its way up and on its way down, beside the curve itself.

A partial residual plot: the curve's own value plus what the measurement has more than the free run, at the pulse width
in force one mean lag of the linear part earlier. Where both directions lie on the curve, one curve is enough for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from stimrig.api.charts.hover import on

WINDOW_S = 0.6
"""A slope is taken over this long; a pulse width that jumps or turns within it has no direction."""
FASTEST_US_PER_S = 200.0
BINS = 16
LEAST_SAMPLES = 3


def seen(document: dict[str, Any], curves: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Points by direction.

    Parameters
    ----------
    document : dict
        MODEL.json.
    curves : dict
        As `stimrig.api.workers.verbs.curves` gives them.

    Returns
    -------
    dict
        ``rising`` and ``falling``: ``pulse_width_us``, µs, and ``torque_nm``, N·m; absent where the recording has none.
    """
    time_s, width_us = curves["time_s"], curves["pulse_width_us"]
    if len(time_s) < 3:
        return {}
    step_s = (time_s[-1] - time_s[0]) / (len(time_s) - 1)
    lag = round(mean_lag_s(document["linear"]) / step_s)
    half = max(1, round(WINDOW_S / 2 / step_s))
    top_us = max(width_us)
    sums: dict[tuple[str, int], list[float]] = {}
    for index in range(lag + half, len(time_s) - half):
        at = index - lag
        way = direction(width_us[max(0, at - half) : at + half + 1], 2 * half * step_s, top_us)
        predicted = curves["predicted_torque_nm"][index]
        if way and predicted is not None:
            bin_ = min(BINS - 1, int(BINS * width_us[at] / top_us))
            found = sums.setdefault((way, bin_), [0.0, 0.0, 0.0])
            for place, value in enumerate((1.0, width_us[at], curves["torque_nm"][index] - predicted)):
                found[place] += value
    return collected(sums, document["recruitment"])


def direction(widths_us: Sequence[float], span_s: float, top_us: float) -> str | None:
    """rising, falling, or None where the width stands, jumps or turns."""
    steps = [after - before for before, after in pairwise(widths_us)]
    change = widths_us[-1] - widths_us[0]
    slow = 0.02 * top_us < abs(change) < FASTEST_US_PER_S * span_s
    even = max(abs(step) for step in steps) < 0.5 * abs(change)
    if not (slow and even):
        return None
    if all(step >= 0 for step in steps):
        return "rising"
    return "falling" if all(step <= 0 for step in steps) else None


def mean_lag_s(linear: dict[str, Any]) -> float:
    """How far the torque of a ramp trails: 2 ζ T + delay for the second order, 0 where it is not known."""
    time_s, damping = linear.get("time_constant_s"), linear.get("damping")
    if time_s is None or damping is None:
        return 0.0
    return max(0.0, 2.0 * damping * time_s + (linear.get("delay_s") or 0.0))


def collected(sums: dict[tuple[str, int], list[float]], curve: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Means of the bins, on the curve."""
    found: dict[str, dict[str, list[float]]] = {}
    for (way, _bin), (count, width, more) in sorted(sums.items()):
        if count < LEAST_SAMPLES:
            continue
        points = found.setdefault(way, {"pulse_width_us": [], "torque_nm": []})
        points["pulse_width_us"].append(round(width / count, 2))
        on_curve = on(width / count, curve["pulse_width_us"], curve["torque_nm"])
        points["torque_nm"].append(round(on_curve + more / count, 4))
    return found
