"""Statement, curves and course over the record of the free effects of a fit, with 95 % intervals."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import numpy as np

from stimrig.identify.dynamics.terms import QUICK_S, Driver, Place
from stimrig.identify.effects import find_effect
from stimrig.identify.effects.terms import AFTER_LAGS, PERCENTILES, acting, later
from stimrig.identify.estimation.solve import Fitted, once
from stimrig.identify.estimation.uncertainty import square_root
from stimrig.identify.problem.problem import Chosen

DRAWS = 200
POINTS = 500
"""Most points of a course."""
CANCELLED = 0.5
"""Two terms nearly cancel where both together change the torque by less than this share of what one of them does."""


def shape_of(fitted: Fitted, index: int, matrix: np.ndarray) -> dict[str, Any] | None:
    """Describe one effect of a fit in words and curves; None for an effect that is not free.

    `index`: of the effect in `fitted.problem.chosen`. `matrix`: covariance of all parameters in their units. Returns
    `place`, `driven_by`, `words`, `equation`, `behaves_as`, `driver`, `at`, `effect`, `lines` (by name `value`, `lower`
    and `upper`, 95 % of draws of the effect's parameters, each of shape (n,)), and `course` (`time_s`, `driver`, a
    share, and `value`, what the term does then).
    """
    chosen = fitted.problem.chosen[index]
    shape = find_effect(chosen.effect).shape
    if shape is None:
        return None
    places = list(chosen.places)
    normal = np.random.default_rng(0).standard_normal((DRAWS, len(places)))
    draws = fitted.physical[places] + normal @ square_root(matrix[np.ix_(places, places)])
    bounds = np.array([(p.lower, p.upper) for p in chosen.parameters]).T
    rows = np.vstack([fitted.physical[places], np.clip(draws, *bounds)])
    values = {p.name: rows[:, [i]] for i, p in enumerate(chosen.parameters)}
    described = shape(chosen.form, values)
    lines = {}
    for name, drawn in described.lines.items():
        lower, upper = np.percentile(drawn[1:], PERCENTILES, axis=0)
        lines[name] = {"value": drawn[0].tolist(), "lower": lower.tolist(), "upper": upper.tolist()}
    names = " or ".join(find_effect(name).name.lower() for name in described.behaves_as)
    note = f" It behaves as {names}." if names else ""
    if opposed := _opposed(fitted).get(chosen.effect, []):
        note = f" It counts only together with {' and '.join(opposed)}: over this record they nearly cancel."
    return {key: getattr(described, key) for key in ("place", "driven_by", "driver", "effect")} | {
        "words": described.words + note,
        "equation": f"{described.equation}; y_max = {fitted.problem.setup.scale_nm:.3g} N·m",
        "behaves_as": [] if opposed else list(described.behaves_as),
        "at": described.at.tolist(),
        "lines": lines,
        "course": _course(fitted, chosen),
    }


@once
def _opposed(fitted: Fitted) -> dict[str, list[str]]:
    """By term, the names of those each of which nearly cancels it (`CANCELLED`) over the fitted rows."""
    problem, rows = fitted.problem, fitted.problem.setup.fitted
    terms = [chosen for chosen in problem.chosen if chosen.form.stage == "term"]
    opposed: dict[str, list[str]] = {term.effect: [] for term in terms}

    def run_without(*left_out: Chosen) -> np.ndarray:
        theta = fitted.theta.copy()
        theta[[term.first for term in left_out]] = 0.0
        return problem.run(theta)[0][rows]

    torque_nm = run_without()
    alone = {term.effect: np.linalg.norm(torque_nm - run_without(term)) for term in terms}
    for term, other in combinations(terms, 2):
        both = np.linalg.norm(torque_nm - run_without(term, other))
        if both < CANCELLED * max(alone[term.effect], alone[other.effect]):
            for one, against in ((term, other), (other, term)):
                opposed[one.effect].append(f"“{find_effect(against.effect).name}”")
    return opposed


def _course(fitted: Fitted, chosen: Chosen) -> dict[str, list[float]]:
    """The driver and the effect of a term over the record, by the model's own torque."""
    problem, setup, theta = fitted.problem, fitted.problem.setup, fitted.theta.copy()
    place, driver = Place(int(chosen.form.law["place"])), Driver(int(chosen.form.law["driver"]))
    # the torque that drives a term is that before the terms at the cell
    theta[[each.first for each in problem.chosen if each.form.law.get("place") in AFTER_LAGS]] = 0.0
    width_us, drive_nm, torque_nm = problem.inner_signals(theta)
    torque, rise = torque_nm / setup.scale_nm, np.diff(torque_nm) / setup.scale_nm * QUICK_S / setup.grid.step_s
    shares = {
        Driver.DRIVE: drive_nm / setup.scale_nm,
        Driver.RISE: np.maximum(rise, 0.0),
        Driver.FALL: np.maximum(-rise, 0.0),
        Driver.PULSES: setup.present,
        Driver.SQUARE: torque[1:] ** 2,
        Driver.WIDTH_PLAY: width_us / setup.basis.largest_us,
    }
    share, x = shares.get(driver, torque[1:]), 0.0
    size, other = (*fitted.physical[list(chosen.places)].tolist(), 0.0)[:2]
    states = np.array(share)
    if driver != Driver.SQUARE:
        keep, starts = math.exp(-setup.grid.step_s / other), set(setup.grid.starts.tolist())
        for k, (now, rest_s) in enumerate(zip(share.tolist(), setup.scene.rest_s.tolist(), strict=True)):
            lagging = now + (x * math.exp(-rest_s / other) - now) * keep
            behind = 0.0 if k in starts else x  # a play begins anew with each part
            x = lagging if later(driver) else min(max(behind, now - other), now + other)
            states[k] = x
    shown = slice(None, None, math.ceil(share.size / POINTS))
    times_s = setup.scene.time_s + setup.grid.start_s
    columns = {"time_s": times_s, "driver": share, "value": acting(place, size * states)}
    return {name: [float(f"{each:.4g}") for each in column[shown]] for name, column in columns.items()}
