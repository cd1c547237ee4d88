"""The next experiment: the shortest test, among those that the rig can do, that separates rival effects."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.effects import get
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.effect_fit import fitted_with
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.experiments.designs import Design, designs
from stimrig.identify.noise import whitened
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.problem import Problem

ENOUGH = 7.0
"""Expected log evidence that is enough to decide: odds of about 1000 to 1."""
PER_PULSE = 4
"""Samples per pulse of the simulated test."""


def next_experiment(record: Record, rivals: Sequence[str]) -> dict[str, Any]:
    """Find the shortest test that separates rival effects, by simulating each as it was fitted to this record.

    Parameters
    ----------
    record : Record
        The record that does not separate the rivals.
    rivals : sequence of str
        Ids of effects. A single one is compared with a model without effects.

    Returns
    -------
    dict
        `segments` for the rig (`name`, `sequence`, `settings`), `duration_s`, `dose`, `expected_log_evidence` (of the
        pair with the smallest), `decides`, `text`, `alternatives` (all designs, best first).

    Raises
    ------
    BadRequest
        An effect is unknown, or none is given.
    """
    names = list(dict.fromkeys(rivals))
    if not names:
        raise BadRequest("no rival was named", place="rivals", fix="Name two effects.")
    for name in names:
        get(name)
    fits = {name: fitted_with(record, [name]) for name in names}
    if len(names) == 1:
        fits["nothing"] = fitted_with(record, [])
    return plan(record, fits)


def plan(record: Record, fits: dict[str, Fitted]) -> dict[str, Any]:
    """As `next_experiment`, for rivals that are already fitted, by name."""
    names = [name for name in fits if name != "nothing"]
    largest_us = float(record.pulse_width_us.max())
    rows = [_row(design, record, fits) for design in designs(largest_us)]
    enough = [row for row in rows if row["expected_log_evidence"] >= ENOUGH]
    rows.sort(key=lambda row: -row["expected_log_evidence"] / row["duration_s"])
    best = min(enough, key=lambda row: row["duration_s"]) if enough else rows[0]
    return best | {
        "rivals": names,
        "decides": best["expected_log_evidence"] >= ENOUGH,
        "text": _text(best, names),
        "alternatives": [{key: row[key] for key in ("design", "duration_s", "expected_log_evidence")} for row in rows],
    }


def _text(best: dict[str, Any], names: list[str]) -> str:
    those = " from ".join(get(name).name.lower() for name in names[:2])
    test = f"{best['words']} ({best['duration_s']:.0f} s)"
    gain = best["expected_log_evidence"]
    if gain >= ENOUGH:
        return f"{test} should separate {those}: expected log evidence {gain:.0f}."
    return (
        f"{test} is the best test to separate {those}, but it may not be enough: expected log evidence {gain:.1f}; "
        f"at least {ENOUGH:g} is required."
    )


def _row(design: Design, record: Record, fits: dict[str, Fitted]) -> dict[str, Any]:
    width = design.pulse_widths(record.pulse_rate_hz)
    simulated = _blank(record, width)
    pairs = {}
    for one, other in permutations(fits, 2):
        pairs[f"{one} against {other}"] = separation(fits[one], fits[other], simulated)
    first = next(iter(fits.values()))
    table = first.physical[first.problem.coefficients] @ first.problem.setup.basis.design(width).T
    return {
        "design": design.name,
        "words": design.words,
        "segments": [{"name": s.name, "sequence": s.sequence, "settings": s.settings} for s in design.segments],
        "duration_s": width.size / record.pulse_rate_hz,
        "dose": {
            "pulses": int(np.sum(width > 0)),
            "pulse_width_sum_us": float(width.sum()),
            "torque_time_nm_s": float(np.abs(table).sum() / record.pulse_rate_hz),
        },
        "expected_log_evidence": float(min(pairs.values())),
        "pairs": pairs,
    }


def _blank(record: Record, width: np.ndarray) -> Record:
    rate = PER_PULSE * record.pulse_rate_hz
    held = np.repeat(width, PER_PULSE)
    time_s = np.arange(held.size) / rate
    angle = None if record.angle_rad is None else np.full(held.size, float(record.angle_rad[0]))
    still = None if record.velocity_rad_s is None else np.zeros(held.size)
    return Record.from_arrays(
        time_s,
        held,
        np.zeros(held.size),
        angle_rad=angle,
        velocity_rad_s=still,
        pulse_rate_hz=record.pulse_rate_hz,
    )


def separation(truth: Fitted, rival: Fitted, record: Record) -> float:
    """Log evidence by which a rival is expected to lose in a new test, if `truth` is true.

    The rival is fitted again to the new test, with its fit to the old record as prior.
    """
    true_mean = _simulate(truth, record, False)[0]
    rival_mean, slopes = _simulate(rival, record, True)
    assert slopes is not None
    size = true_mean.size
    stretch = (np.array([0], np.int64), np.array([size], np.int64))
    white = whitened(np.vstack([true_mean - rival_mean, slopes]), stretch, truth.noise)
    gap, slopes = white[0], white[1:]
    hessian = rival.hessian
    b = slopes @ gap
    gain = b @ np.linalg.lstsq(hessian + slopes @ slopes.T, b, rcond=None)[0]
    return max(0.5 * float(gap @ gap - gain), 0.0)


def _simulate(fitted: Fitted, record: Record, derivatives: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Interval means of a fitted candidate on another record, without unpredictable effects."""
    grid = make_grid(record)
    setup = fitted.problem.setup.with_(grid=grid, target_nm=np.zeros(grid.size), fitted=np.ones(grid.size, bool))
    kept = [(effect, form) for effect, form in fitted.effects if get(effect).predictable]
    problem = Problem(setup, kept)
    # Parameters are copied by name: the new test has one part, starts at rest, and has no unpredictable effects.
    known = {name: place for place, name in enumerate(fitted.problem.names)}
    place = np.array([known[name] for name in problem.names])
    theta = fitted.theta[place]
    theta[list(problem.initials)] = 0.0
    mean, slopes = problem.run(theta, derivatives=derivatives)
    if slopes is None:
        return mean, None
    full = np.zeros((fitted.theta.size, mean.size))
    full[place] = slopes
    return mean, full
