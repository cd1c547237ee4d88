"""An effect added to a model: its likeliest form, and the evidence for it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from identify.effects import get, registry
from identify.effects.base import STAGES, Effect, Form, Scene
from identify.errors import BadRequest, NotIdentifiable
from identify.estimation.joint import Fitted, solve, start_from
from identify.estimation.prepare import Raw, plain, prepare
from identify.estimation.rows import fitted_rows
from identify.noise.level import find_band
from identify.records.record import Record
from identify.simulation.problem import Problem

PATIENCE = 2
"""Steps of a chain (one bump, two bumps, …) without a gain after which it ends: one of four bumps hardly helps."""
TOLERANCE = 0.1
"""Gain in log posterior below which a candidate's search ends: a fortieth of the least margin."""
WORTHLESS = -2.0
"""Log evidence gained that decides nothing: an effect that gains less is not worth more steps of a search."""
BAND_COST = 16.0
"""Log evidence that a narrow band's three numbers cost."""


@dataclass(frozen=True)
class Candidate:
    """One effect added to a model.

    Parameters
    ----------
    effect : Effect
        Which.
    form : Form
        Its likeliest form.
    fitted : Fitted
        The model with it.
    gain : float
        Log evidence over the model without it, the effect's prior odds included.
    forms : dict
        Gain by form.
    """

    effect: Effect
    form: Form
    fitted: Fitted
    gain: float
    forms: dict[str, float]


def try_effect(
    effect: Effect, base: Fitted, forms: Iterable[Form] | None = None, least: float = WORTHLESS
) -> Candidate | None:
    """The effect's best form added to a model; None where there is nothing to start from.

    What promises to gain less than `least` is not followed to its end.
    """
    if effect.band:
        return try_band(effect, base)
    best: Fitted | None = None
    best_form: Form | None = None
    gains: dict[str, float] = {}
    previous: dict[str, float] = {}
    idle, top = 0, -np.inf
    residual = base.residual_nm
    for form in forms or effect.forms:
        if not form.grows:
            previous, residual, idle, top = {}, base.residual_nm, 0, -np.inf
        elif idle >= PATIENCE:
            continue
        # A chain needs each of its steps at its best: the next begins there.
        whole = form.propose is not None or least == -np.inf
        floor = max(base.log_evidence + least - effect.prior, best.log_evidence if best else -np.inf)
        found = fit_form(effect, form, base, residual, previous, -np.inf if whole else floor)
        if found is None:
            idle = PATIENCE
            continue
        gain = found.log_evidence - base.log_evidence + effect.prior
        idle, top = (0, gain) if gain > max(top, 0.0) else (idle + 1, top)
        gains[form.name] = gain
        previous, residual = found.parameters_of(effect.id), found.residual_nm
        if best is None or found.log_evidence > best.log_evidence:
            best, best_form = found, form
    if best is None or best_form is None:
        return None
    return Candidate(effect, best_form, best, gains[best_form.name], gains)


def try_band(effect: Effect, base: Fitted) -> Candidate | None:
    """A narrow band added to the noise."""
    setup = base.problem.setup
    noise, log_likelihood = find_band(base.residual_nm, setup.stretches, setup.grid.step_s)
    if log_likelihood - base.log_likelihood < BAND_COST:
        return None
    found = solve(base.problem, base.theta, noise)
    gain = found.log_evidence - base.log_evidence - BAND_COST + effect.prior
    return Candidate(effect, effect.forms[0], found, gain, {"narrow_band": gain})


def fit_form(
    effect: Effect,
    form: Form,
    base: Fitted,
    residual: np.ndarray,
    previous: dict[str, float],
    floor: float = -np.inf,
) -> Fitted | None:
    """One form added to a model, from each of its starting values; the best. What stays below the floor is given up."""
    setup = base.problem.setup
    scene: Scene = setup.scene
    problem = Problem(setup, [*base.effects, (effect.id, form)])
    starts = form.starts(scene)
    if form.propose is not None:
        starts = form.propose(np.where(setup.fitted, residual, np.nan), scene, previous)
    best: Fitted | None = None
    for start in starts:
        apart = start.get("base.damping")
        if apart is not None and "base.time_constant_s" not in start and base.physical[1] >= apart:
            continue  # the base has its lags apart already
        theta = start_from(problem, base, {len(base.effects): start})
        found = solve(problem, theta, base.noise, tolerance=TOLERANCE, floor=floor)
        if form.accept is not None and not form.accept(found.parameters_of(effect.id), scene):
            continue
        if best is None or found.log_evidence > best.log_evidence:
            best = found
            floor = max(floor, found.log_evidence)
    return best


def names(fitted: Fitted) -> list[str]:
    """Effects in a model, tremor included where the noise has a narrow band."""
    listed = [name for name, _ in fitted.effects]
    if fitted.noise.band > 0.0:
        listed += [effect.id for effect in registry().values() if effect.band and effect.id not in listed]
    return listed


def add(base: Fitted, effect: Effect, form: str, raw: Raw) -> Fitted:
    """The model with one effect more, in the form named or in its likeliest.

    Raises
    ------
    BadRequest
        It has no such form.
    NotIdentifiable
        It needs a column that the record lacks, or isn't there to be started from.
    """
    for need in effect.needs:
        if getattr(base.problem.setup.grid.record, need) is None:
            raise NotIdentifiable(f"{effect.id} needs the column {need}", place=need, mend="Record it.")
    try:
        forms = [effect.form(form)] if form else list(effect.forms)
    except KeyError as error:
        raise BadRequest(f"{effect.id} has no form {form!r}", place="effects") from error
    for identifier, seen, values in given_by_samples(raw):
        if identifier == effect.id:
            return added(base, identifier, seen, values)
    # What only the raw samples show is not there where they do not.
    # And what somebody asks for is fitted to its end, whatever it gains.
    found = None if any(form.settled for form in forms) else try_effect(effect, base, forms, -np.inf)
    if found is None:
        raise NotIdentifiable(f"nothing in the record looks like {effect.id}", mend="Leave it out.")
    return found.fitted


def added(base: Fitted, identifier: str, form: Form, values: dict[str, float]) -> Fitted:
    """The model with one effect more, fitted from the values given."""
    problem = Problem(base.problem.setup, [*base.effects, (identifier, form)])
    return solve(problem, start_from(problem, base, {len(base.effects): values}), base.noise)


def given_by_samples(raw: Raw) -> list[tuple[str, Form, dict[str, float]]]:
    """Effects that the samples show before any fit: a line of the mains, a ceiling; with their parameters."""
    found = []
    for effect in sorted(registry().values(), key=lambda effect: STAGES.index(effect.stage)):
        seen = effect.seen(raw) if effect.seen is not None else None
        if seen is not None:
            found.append((effect.id, effect.form(seen[0]), seen[1]))
    return found


def with_effects(base: Fitted, wanted: Sequence[str], raw: Raw) -> Fitted:
    """The model and the effects named, each in its likeliest form, or in the one named after a colon.

    Raises
    ------
    BadRequest, NotIdentifiable
        As `add`; no effect of that name.
    """
    for name in wanted:
        identifier, _, form = name.partition(":")
        base = add(base, get(identifier), form, raw)
    return base


def fitted_with(record: Record, wanted: Sequence[str]) -> Fitted:
    """The plain structure of a record with the effects named."""
    grid, raw = prepare(record)
    return with_effects(plain(grid, fitted_rows(grid, None)), wanted, raw)
