"""Contradictions between the parts of a record: the same structure fitted to each part predicts other torques.

A wrong structure has other best parameters for another protocol (Shuttleworth and others 2023), so the difference
between the parts' predictions of common inputs shows an error that no library of effects need name. `contradiction`
compares the parts of a fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.left_out import LEAST_ROWS, near_widths
from stimrig.identify.estimation.rests import RELAXED_S, SHORT, since_pulse
from stimrig.identify.estimation.solve import Fitted, knows_joint
from stimrig.identify.noise import WHITE_AND_SLOW, NoiseLevel, profile

LEAST_S = 1.5
"""A part with less stimulation is not fitted by itself: a muscle's answer is as long."""
ALARM_RATE = 0.05
"""Share of records of exact muscles for whose pairs of parts, all together, a contradiction is stated, at most."""
NORMAL_QUANTILES = {1: 1.645, 2: 1.960, 3: 2.128, 4: 2.241}
"""By the number of pairs, above which a normal number lies with a probability of `ALARM_RATE` over that number."""
INEXACT = 3.0
"""Mean square in standard errors that counts as one: noise, smoothness and the step are estimates. Of 126 records of
exact muscles (white, slow and first-order noise, hum, breath, a zero that wanders) 13 alarmed at 1, 6 at 2 and 3 at 3,
those with breath or a zero that wanders."""
WINDOW_S = 0.25
"""On either side of the place with the largest difference."""
RISE_S, RISE_SHARE = 0.3, 0.004
"""A width rises that has changed by this share of the largest within that time."""
HALVES = ("the first half", "the second half")
RIDGE = 1e-9
"""Share added to the curvature of each parameter that a part does not determine."""


@dataclass(frozen=True)
class Part:
    """One part of the fitted rows, and what one Gauss-Newton step to its own fit needs."""

    rows: np.ndarray  # intervals, bool, shape (K,)
    gain: np.ndarray  # change of the parameters per gradient, shape (P, P), scaled
    change: np.ndarray  # change of the parameters from the whole fit to that of the part, shape (P,), scaled
    information: np.ndarray  # shape (P, P), scaled


def contradiction(fitted: Fitted) -> dict[str, Any] | None:
    """Compare the fits of a structure to the parts of its record; None where there is too little to compare.

    Parts are the PRBS, the ramps and all else, each with the rests after it, and the earlier and the later half. The
    refit of a part is one Gauss-Newton step, with the prior centred at the whole fit. Torque that no pulse causes
    differs between parts by nature, so zeros, initial states and effects that cannot be foreseen are fitted again, but
    their differences are not counted.

    Returns `significant`, `false_alarm_rate` and `pairs`, that with the clearest contradiction first. Each pair has
    `parts`; `difference_nm`, the rms difference of their predictions, and `standard_error_nm`; `statistic`, the mean
    square difference in standard errors, and the `limit` above which it is significant; and for the place with the
    largest difference `start_s`, `end_s`, `pulse_width_us`, `direction`, `largest_nm` (the first part's prediction
    minus the second's) and `largest_error_nm`, its standard error.
    """
    if knows_joint(fitted):  # the parts need not cover the same angles
        return None
    problem, setup = fitted.problem, fitted.problem.setup
    parts, whole, scale = _refits(fitted, _part_rows(setup.grid, setup.fitted))
    counted = np.ones(problem.size, bool)
    counted[problem.baselines.start : problem.initials.stop] = False
    for chosen in problem.chosen:
        counted[chosen.places] = find_effect(chosen.effect).predictable
    slopes = fitted.slopes * (scale * counted)[:, None]
    pairs = []
    for first, second in combinations(parts, 2):
        part, other = parts[first], parts[second]
        if (first in HALVES) != (second in HALVES):
            continue
        rows = setup.fitted & near_widths(setup.grid, part.rows) & near_widths(setup.grid, other.rows)
        if np.sum(rows & (setup.grid.pulse_width_us > 0.0)) >= LEAST_ROWS:
            pairs.append(_pair((first, second), part, other, whole, slopes[:, rows], setup.grid, np.flatnonzero(rows)))
    if not pairs:
        return None
    for pair in pairs:
        pair["limit"] = INEXACT * _upper_mean_square(pair.pop("freedom"), NORMAL_QUANTILES[len(pairs)])
    pairs.sort(key=lambda pair: -pair["statistic"] / pair["limit"])
    significant = pairs[0]["statistic"] > pairs[0]["limit"]
    return {"significant": bool(significant), "false_alarm_rate": ALARM_RATE, "pairs": pairs}


def _part_rows(grid: Grid, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Rows by the name of their part: kinds of segment, then halves with as much stimulation."""
    stimulated = grid.pulse_width_us > 0.0
    names = grid.record.segment_names
    of_segment = np.array([next((kind for kind in ("prbs", "ramp") if kind in name), "") for name in names])
    others = {name for name, kind in zip(names, of_segment, strict=True) if not kind}
    others = {name for name in others if np.any(stimulated & rows & (grid.segment == names.index(name)))}
    other = others.pop() if len(others) == 1 else "the other parts"
    last = np.maximum.accumulate(np.where(stimulated, np.arange(grid.size), 0))  # a rest belongs to what it follows
    kind = of_segment[grid.segment[last]]
    part_rows = {label: rows & (kind == key) for key, label in (("prbs", "prbs"), ("ramp", "ramp"), ("", other))}
    count = np.cumsum(rows & stimulated)
    part_rows |= dict(zip(HALVES, (rows & (2 * count <= count[-1]), rows & (2 * count > count[-1])), strict=True))
    min_rows = LEAST_S / grid.step_s
    return {label: part for label, part in part_rows.items() if np.sum(part & stimulated) >= min_rows}


def _refits(fitted: Fitted, part_rows: Mapping[str, np.ndarray]) -> tuple[dict[str, Part], np.ndarray, np.ndarray]:
    """Return the parts by name, the covariance of the whole fit, and the scale of the parameters that both are in."""
    problem, setup = fitted.problem, fitted.problem.setup
    precision = problem.prior[1]
    white = setup.whitened(np.vstack([fitted.residual_nm, fitted.slopes]), noise_at_rest(fitted))
    at = np.concatenate([np.arange(start, stop) for start, stop in zip(*setup.stretches, strict=True)])
    residual, slopes = white[0], white[1:]
    scale = 1.0 / np.sqrt(np.maximum(np.sum(slopes**2, axis=1) + np.diag(precision), 1e-300))
    slopes = slopes * scale[:, None]
    prior = precision * scale[:, None] * scale + RIDGE * np.eye(scale.size)
    covariance = np.linalg.inv(slopes @ slopes.T + prior)
    parts = {}
    for name, rows in part_rows.items():
        of_part = slopes[:, rows[at]]
        information = of_part @ of_part.T
        gain = np.linalg.inv(information + prior)
        parts[name] = Part(rows, gain, gain @ (of_part @ residual[rows[at]]), information)
    return parts, covariance, scale


def noise_at_rest(fitted: Fitted) -> NoiseLevel:
    """Return the noise that the rests show, where a fit has taken some for slow: it may be what the structure lacks.

    A zero that wanders from rest to rest is part of it. Never more than the noise of the fit.
    """
    setup, noise = fitted.problem.setup, fitted.noise
    grid = setup.grid
    relaxed = setup.fitted & (grid.step_s * since_pulse(grid) > RELAXED_S)
    rests = [rest for rest in grid.stretches(relaxed) if rest.stop - rest.start > SHORT]
    if noise.is_white or not rests:
        return noise
    residual = fitted.residual_nm / setup.spread
    residual = residual - np.mean(np.concatenate([residual[rest] for rest in rests]))  # a wrong zero is no noise
    at_rest = profile(residual, ends_of(rests), WHITE_AND_SLOW.of_steps(grid.step_s))[0]
    return min(at_rest, noise, key=lambda level: level.sd_nm)


def _pair(
    names: tuple[str, str],
    first: Part,
    second: Part,
    whole: np.ndarray,
    slopes: np.ndarray,
    grid: Grid,
    at: np.ndarray,
) -> dict[str, Any]:
    """Compare two parts at intervals `at`, where `slopes` are the derivatives of the torque, N·m."""
    difference = (first.change - second.change) @ slopes
    # The residual of a fit has lost what the fit took: its covariance is I - X' whole X where the model is right.
    gained = [part.gain @ part.information for part in (first, second)]
    lost = gained[0] - gained[1]
    covariance = gained[0] @ first.gain + gained[1] @ second.gain - lost @ whole @ lost.T
    sd = np.sqrt(np.maximum(np.sum((covariance @ slopes) * slopes, axis=0), 0.0))
    sd = np.maximum(sd, 1e-3 * max(float(sd.max()), 1e-300))
    weighted = slopes / sd
    spread = covariance @ (weighted @ weighted.T) / at.size
    half = round(WINDOW_S / grid.step_s)
    worst = int(np.argmax(np.abs(difference)))
    near = at[np.abs(at - at[worst]) <= half]
    widths_us = grid.pulse_width_us
    rise_us = float(np.mean(widths_us[near] - widths_us[np.maximum(near - round(RISE_S / grid.step_s), 0)]))
    direction = "held" if abs(rise_us) < RISE_SHARE * widths_us.max() else "rising" if rise_us > 0.0 else "falling"
    return {
        "parts": list(names),
        "difference_nm": float(np.sqrt(np.mean(difference**2))),
        "standard_error_nm": float(np.sqrt(np.mean(sd**2))),
        "statistic": float(np.mean((difference / sd) ** 2)),
        "freedom": float(np.trace(spread) ** 2 / max(np.sum(spread * spread.T), 1e-300)),
        "start_s": float(grid.time_s[near[0]]),
        "end_s": float(grid.time_s[near[-1]] + grid.step_s),
        "pulse_width_us": [float(widths_us[near].min()), float(widths_us[near].max())],
        "direction": direction,
        "largest_nm": float(difference[worst]),
        "largest_error_nm": float(sd[worst]),
    }


def _upper_mean_square(freedom: float, normal: float) -> float:
    """Quantile of chi square over its freedom (Wilson and Hilferty 1931), at that of a normal number."""
    return float((1.0 - 2.0 / (9.0 * freedom) + normal * np.sqrt(2.0 / (9.0 * freedom))) ** 3)
