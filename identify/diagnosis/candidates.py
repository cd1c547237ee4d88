"""Every effect of the library tried on a record: its likeliest form, and the evidence for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass

import numpy as np

from identify.effects import registry
from identify.effects.base import Effect, Form, Scene
from identify.estimation.joint import Fitted, solve, start_from
from identify.noise.level import find_band
from identify.simulation.problem import Problem
from identify.simulation.setup import Setup

WORKERS = 2
FORMS = 3
"""Forms of an effect tried beside another effect."""
PATIENCE = 2
"""Steps of a chain (one bump, two bumps, …) without a gain after which it ends: one of four bumps hardly helps."""
BAND_COST = 16.0
"""Log evidence that a narrow band's three numbers cost."""

Progress = Callable[[float, str], None]


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


def applicable(effect: Effect, setup: Setup, present: Iterable[str]) -> bool:
    """Whether an effect can be considered: its columns are there, it isn't sought elsewhere, it isn't in already."""
    record = setup.grid.record
    if effect.raw or effect.id in present:
        return False
    return all(getattr(record, need) is not None for need in effect.needs)


def try_effect(effect: Effect, base: Fitted, forms: Iterable[Form] | None = None) -> Candidate | None:
    """The effect's best form added to a model; None where there is nothing to start from."""
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
        found = fit_form(effect, form, base, residual, previous)
        if found is None:
            idle = PATIENCE
            continue
        gain = found.log_evidence - base.log_evidence + effect.prior
        idle, top = (0, gain) if gain > max(top, 0.0) else (idle + 1, top)
        gains[form.name] = gain
        if form.propose is not None:
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
    effect: Effect, form: Form, base: Fitted, residual: np.ndarray, previous: dict[str, float]
) -> Fitted | None:
    """One form added to a model, from each of its starting values; the best."""
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
        found = solve(problem, theta, base.noise, floor=None if best is None else best.log_evidence)
        if form.accept is not None and not form.accept(found.parameters_of(effect.id), scene):
            continue
        if best is None or found.log_evidence > best.log_evidence:
            best = found
    return best


def names(fitted: Fitted) -> list[str]:
    """Effects in a model, tremor included where the noise has a narrow band."""
    listed = [name for name, _ in fitted.effects]
    if fitted.noise.band > 0.0:
        listed += [effect.id for effect in registry().values() if effect.band and effect.id not in listed]
    return listed


def likeliest_forms(effect: Effect, before: Candidate | None) -> list[Form]:
    """Forms worth a fit beside another effect: those that did best alone; chains are kept whole."""
    if before is None or effect.band or any(form.grows for form in effect.forms):
        return list(effect.forms)
    ranked = sorted(before.forms, key=lambda name: -before.forms[name])
    return [effect.form(name) for name in ranked[:FORMS]]


def scan(
    base: Fitted,
    effects: Iterable[Effect],
    progress: Progress | None = None,
    share: tuple[float, float] = (0.0, 1.0),
    before: list[Candidate] | None = None,
) -> list[Candidate]:
    """Every applicable effect added to a model, best first; `before` is what an earlier round found of them."""
    present = set(names(base))
    listed = [effect for effect in effects if applicable(effect, base.problem.setup, present)]
    done = 0
    found: list[Candidate] = []
    # Costly ones first, so that both workers end together; the compiled parts release the interpreter.
    listed.sort(key=lambda effect: -len(effect.forms))
    with ThreadPoolExecutor(WORKERS) as pool:
        earlier = {candidate.effect.id: candidate for candidate in before or []}
        waiting = {
            pool.submit(try_effect, effect, base, likeliest_forms(effect, earlier.get(effect.id))): effect
            for effect in listed
        }
        try:
            for future in as_completed(waiting):
                done += 1
                if progress is not None:
                    text = f"tried {waiting[future].name.lower()}"
                    progress(share[0] + (share[1] - share[0]) * done / len(listed), text)
                candidate = future.result()
                if candidate is not None:
                    found.append(candidate)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return sorted(found, key=lambda candidate: -candidate.gain)
