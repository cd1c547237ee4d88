"""Terms that may be added to a model: what each promises, and the fit of one.

One derivative of the model by the sizes of all terms at zero tells what each would gain. The most promising are fitted.
The noise is held as the rests show it: slow noise of any size would take up what a term is to describe, and ask for the
increments alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.effects import registry
from stimrig.identify.effects.base import Effect, replaced_by
from stimrig.identify.effects.terms import tried_at
from stimrig.identify.estimation.rests import wandering_zero_nm
from stimrig.identify.estimation.solve import LARGEST_SLOPE, Fitted, solve, solve_scaled, start_from
from stimrig.identify.noise import WHITE, beside_zero
from stimrig.identify.problem.problem import Problem

MAX_TERMS, FITTED_TERMS = 6, 5
"""Terms at most; and so many, of those that promise most, are fitted in each round."""
ZERO_MEMORY_S = 20.0
"""Memory of a zero that wanders."""
STEPS = 5
"""Steps of the search by which the terms of a round are compared; the likeliest one is then fitted to its end."""
LEAST_SIZE = 1e-6
"""A term of this size does nothing: where the torque runs away with it, the base does."""
Start = tuple[Effect, dict[str, float]]
"""A term and the values from which it is fitted."""


def fix_noise(fitted: Fitted) -> Fitted:
    """The model searched again with white noise, beside what the rests show of the zero.

    A zero that moves is no white noise: terms would take it up.
    """
    setup, problem = fitted.problem.setup, fitted.problem
    fitted = fitted if fitted.noise.held else solve(problem, fitted.theta, WHITE)
    wander_nm = wandering_zero_nm(setup.grid, setup.fitted, fitted.residual_nm)
    noise = beside_zero(wander_nm, fitted.rms_nm, ZERO_MEMORY_S, setup.grid.step_s) if wander_nm else WHITE
    return solve(problem, fitted.theta, noise) if noise.share or fitted.noise.share else fitted


def fit_terms(base: Fitted, progress: Callable[[float, str], None]) -> list[Fitted]:
    """The model, whose noise is held, with each of the terms that promise most."""
    starts = promising(base)

    def fit(at: int) -> Fitted:
        """Without the problem: it holds functions, which cannot be sent between processes."""
        return replace(fit_term(base, *starts[at]), problem=None)  # type: ignore

    fits: list[Fitted] = []
    for at, fitted in side_by_side(fit, len(starts)):
        fits.append(replace(fitted, problem=_with_term(base, starts[at][0])))
        progress(len(fits) / len(starts), f"tried {starts[at][0].name.lower()}")
    return fits


def promising(base: Fitted) -> list[Start]:
    """The terms that promise the largest gains of log-likelihood by one step from the model, the best lag of each."""
    terms = [effect for effect in registry().values() if effect.shape and effect.id not in dict(base.effects)]
    present = sum(form.stage == "term" for _, form in base.effects)
    if not terms or present >= MAX_TERMS or replaced_by(base.effects, terms[0].forms):
        return []
    tried = [(effect, value) for effect in terms for value in tried_at(effect.forms[0])]
    forms = [
        (
            f"{effect.id} {value}",
            replace(
                effect.forms[0], parameters=effect.forms[0].parameters[:1], law=effect.forms[0].law | {"lag": value}
            ),
        )
        for effect, value in tried
    ]
    setup, known = base.problem.setup, base.theta.size
    wide = Problem(setup, [*base.effects, *forms])
    slopes = wide.run(start_from(wide, base, {}), derivatives=True)[1]
    assert slopes is not None
    white = setup.whitened(np.vstack([base.residual_nm, slopes]), base.noise)
    residual, own, new = white[0], white[1 : known + 1], white[known + 1 :]
    shared = own @ new.T
    information = np.sum(new**2, 1) - np.sum(shared * solve_scaled(base.hessian, shared), 0)
    size = (new @ residual) / (information + np.diag(wide.prior[1])[known:])
    gain = 0.5 * size * (new @ residual)
    best: dict[str, Start] = {}
    for place in np.argsort(-gain):
        effect, value = tried[place]
        names = [p.name for p in effect.forms[0].parameters]
        best.setdefault(
            effect.id, (effect, dict(zip(names, (float(np.clip(size[place], -1.0, 1.0)), value), strict=False)))
        )
    return [*best.values()][:FITTED_TERMS]


def fit_term(base: Fitted, effect: Effect, values: dict[str, float]) -> Fitted:
    """The model with a term, after `STEPS` steps from some values; where the torque runs away, from a smaller size."""
    problem = _with_term(base, effect)
    start, size = start_from(problem, base, {len(base.effects): values}), problem.chosen[-1].first
    while abs(start[size]) > LEAST_SIZE:
        slopes = problem.run(start, derivatives=True)[1]
        if np.max(np.abs(slopes)) < LARGEST_SLOPE:  # type: ignore
            break
        start[size] *= 0.3
    return solve(problem, start, base.noise, max_steps=STEPS)


def _with_term(base: Fitted, effect: Effect) -> Problem:
    return Problem(base.problem.setup, [*base.effects, (effect.id, effect.forms[0])])
