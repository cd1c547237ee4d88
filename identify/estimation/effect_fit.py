"""An effect added to a model: its most likely form, and the evidence for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stimrig.identify.effects import find_effect, registry
from stimrig.identify.effects.base import STAGES, Effect, Form, Scene, replaced_by
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.candidates import trusted
from stimrig.identify.estimation.joint_sensor import with_angle_delay
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import Raw, fitted_rows, prepare
from stimrig.identify.estimation.solve import Fitted, solve, start_from
from stimrig.identify.noise import find_band
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record

PATIENCE = 2
"""A chain of forms (one bump, two bumps, …) ends after this many steps without a gain."""
TOLERANCE = 0.1
"""The fit of a candidate ends when the log posterior rises by less: a fortieth of the smallest margin."""
WORTHLESS = -2.0
"""A candidate that promises a smaller gain of log evidence is not fitted to its end: it decides nothing."""
BAND_COST = 16.0
"""Log evidence that the three parameters of a narrow band cost."""


@dataclass(frozen=True)
class Candidate:
    """One effect added to a model."""

    effect: Effect  # the effect
    form: Form  # its most likely form
    fitted: Fitted  # the model with it
    gain: float  # log evidence gained over the model without it, with the effect's prior odds
    forms: dict[str, float]  # gain by form
    refusal: str | None = None  # in words, why left-out blocks refuse it; None: not asked, or allowed


def try_effect(
    effect: Effect, base: Fitted, forms: Iterable[Form] | None = None, min_gain: float = WORTHLESS
) -> Candidate | None:
    """Add the best form of an effect to a model; None if there is nothing to start from.

    A fit that promises to gain less than `min_gain`, in log evidence, is not continued to its end.
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
        # The next form of a chain starts from this one, which must therefore be fitted to its end.
        whole = form.propose is not None or min_gain == -np.inf
        floor = max(base.log_evidence + min_gain - effect.prior, best.log_evidence if best else -np.inf)
        helps = bool(gains) and max(gains.values()) > 0.0
        fitted = fit_form(effect, form, base, residual, previous, -np.inf if whole else floor, thorough=whole or helps)
        if fitted is None:
            idle = PATIENCE
            continue
        gain = fitted.log_evidence - base.log_evidence + effect.prior
        idle, top = (0, gain) if gain > max(top, 0.0) else (idle + 1, top)
        gains[form.name] = gain
        previous, residual = fitted.parameters_of(effect.id), fitted.residual_nm
        if best is None or fitted.log_evidence > best.log_evidence:
            best, best_form = fitted, form
    if best is None or best_form is None:
        return None
    return Candidate(effect, best_form, best, gains[best_form.name], gains)


def try_band(effect: Effect, base: Fitted) -> Candidate | None:
    """Add a narrow band to the noise; None if it hardly gains."""
    setup = base.problem.setup
    noise, log_likelihood = find_band(base.residual_nm, setup.stretches, setup.grid.step_s)
    if log_likelihood - base.log_likelihood < BAND_COST:
        return None
    fitted = solve(base.problem, base.theta, noise)
    gain = fitted.log_evidence - base.log_evidence - BAND_COST + effect.prior
    return Candidate(effect, effect.forms[0], fitted, gain, {"narrow_band": gain})


def fit_form(
    effect: Effect,
    form: Form,
    base: Fitted,
    residual: np.ndarray,
    previous: dict[str, float],
    floor: float = -np.inf,
    thorough: bool = True,
) -> Fitted | None:
    """Add one form to a model, from each of its starting values, and return the best fit.

    A fit that will not reach the log evidence `floor` is stopped early. Without `thorough` only the most promising
    start is followed, and that no further where its first step promises too little.
    """
    setup = base.problem.setup
    scene: Scene = setup.scene
    problem = Problem(setup, [*base.effects, (effect.id, form)])
    starts = form.starts(scene)
    if form.propose is not None:
        starts = form.propose(np.where(setup.fitted, residual, np.nan), scene, previous)
    thetas = []
    for start in starts:
        apart = start.get("base.damping")
        if apart is not None and "base.time_constant_s" not in start and base.physical[1] >= apart:
            continue  # the lags of the base model already differ
        thetas.append(start_from(problem, base, {len(base.effects): start}))
    if len(thetas) > 1:
        thetas.sort(key=lambda theta: -_promise(base, problem, theta))
    best: Fitted | None = None
    for theta in thetas:
        fitted = solve(problem, theta, base.noise, tolerance=TOLERANCE, floor=floor, patience=2 if thorough else 1)
        if not form.accepts(fitted.parameters_of(effect.id), scene):
            continue
        if best is None or fitted.log_evidence > best.log_evidence:
            best, floor = fitted, max(floor, fitted.log_evidence)
        if not thorough:
            break
    return best


def _promise(base: Fitted, problem: Problem, theta: np.ndarray) -> float:
    """Log likelihood of a start, up to a constant, after a linear step of the parameters that the base model has."""
    residual_nm = problem.setup.target_nm - problem.run(theta)[0]
    white = problem.setup.whitened(residual_nm[None, :], base.noise)[0]
    if not np.all(np.isfinite(white)):
        return -np.inf
    rows, root = base.projector
    part = np.linalg.solve(root, rows @ white)
    return 0.5 * float(part @ part - white @ white)


def effect_names(fitted: Fitted) -> list[str]:
    """Ids of the effects in a model; with `tremor` if its noise has a narrow band."""
    listed = [name for name, _ in fitted.effects]
    if fitted.noise.band > 0.0:
        listed += [effect.id for effect in registry().values() if effect.band and effect.id not in listed]
    return listed


def add_effect(base: Fitted, effect: Effect, form: str, raw: Raw) -> Fitted:
    """The model with one more effect, in the named form or in its most likely one.

    Raises BadRequest: the effect has no such form, or stands against one that is there. NotIdentifiable: it needs a
    column that the record does not have, or its fit finds nothing to start from.
    """
    for need in effect.needs:
        if not base.problem.setup.grid.record.knows(need):
            raise NotIdentifiable(f"{effect.id} needs the column {need}", place=need, fix="Record this column.")
    forms = [_form(effect, form)] if form else list(effect.forms)
    if (other := replaced_by(base.effects, forms)) is not None:
        message = f"{effect.id} and {other} both set the lags: one would be ignored"
        raise BadRequest(message, place="effects", fix="Leave one of them out.")
    for identifier, detected_form, values in detected_effects(raw):
        if identifier == effect.id:
            return fit_from(base, identifier, detected_form, values)
    # An effect that is found in the samples only is absent if they do not show it.
    # A requested effect is fitted to its end, whatever it gains.
    candidate = None if any(form.fixed for form in forms) else try_effect(effect, base, forms, -np.inf)
    if candidate is None:
        raise NotIdentifiable(f"the record shows nothing that looks like {effect.id}", fix="Leave this effect out.")
    return candidate.fitted


def fit_from(base: Fitted, identifier: str, form: Form, values: dict[str, float]) -> Fitted:
    """The model with one more effect, fitted from given starting values."""
    problem = Problem(base.problem.setup, [*base.effects, (identifier, form)])
    return solve(problem, start_from(problem, base, {len(base.effects): values}), base.noise)


def detected_effects(raw: Raw) -> list[tuple[str, Form, dict[str, float]]]:
    """Effects that the samples show before any fit (mains hum, clipping), each with its form and parameters."""
    detected = []
    for effect in sorted(registry().values(), key=lambda effect: STAGES.index(effect.stage)):
        detection = effect.detect(raw) if effect.detect is not None else None
        if detection is not None:
            detected.append((effect.id, effect.form(detection[0]), detection[1]))
    return detected


def add_effects(base: Fitted, wanted: Sequence[str], raw: Raw, report: Callable[[str], None] | None = None) -> Fitted:
    """The model with the named effects, each in its most likely form or in the one given after a colon.

    Of several forms, `id:one|another`, the first is fitted; when all effects are there, the likeliest of them is
    taken. `report` is called with the id of each effect before it is fitted. Raises BadRequest, NotIdentifiable: as
    `add_effect`; or no effect has that name.
    """
    chosen = [(identifier, forms.split("|")) for identifier, _, forms in (name.partition(":") for name in wanted)]
    for identifier, forms in chosen:
        if report is not None:
            report(identifier)
        base = add_effect(base, find_effect(identifier), forms[0], raw)
        if find_effect(identifier).shape:
            base = trusted(base)  # as the search for free effects does after each
    base = with_angle_delay(trusted(base))
    for identifier, forms in chosen:
        for form in forms[1:]:
            if report is not None:
                report(identifier)
            other = in_form(base, identifier, form)
            base = max(base, other, key=lambda fitted: fitted.log_evidence)
    return with_angle_delay(trusted(base))


def in_form(base: Fitted, effect: str, form: str) -> Fitted:
    """The model with one of its effects in another form, fitted from what both forms share.

    Raises BadRequest: the effect has no such form.
    """
    other = _form(find_effect(effect), form)
    problem = Problem(
        base.problem.setup, [(name, other if name == effect else present_form) for name, present_form in base.effects]
    )
    return solve(problem, start_from(problem, base, {}), base.noise, tolerance=TOLERANCE)


def _form(effect: Effect, form: str) -> Form:
    """A form by its name. Raises BadRequest where the effect has none of that name."""
    try:
        return effect.form(form)
    except KeyError as error:
        raise BadRequest(f"{effect.id} has no form {form!r}", place="effects") from error


def fitted_with(record: Record, wanted: Sequence[str]) -> Fitted:
    """The plain structure fitted to a record, with the named effects."""
    grid, raw = prepare(record)
    return add_effects(fit_plain(grid, fitted_rows(grid, None)), wanted, raw)
