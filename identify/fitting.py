"""`fit`: one function for all methods, from a record to a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import find_effect
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.candidates import words
from stimrig.identify.estimation.effect_fit import add_effects
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.plain import renewed_curve
from stimrig.identify.estimation.samples import Raw, fitted_rows, prepare
from stimrig.identify.methods import method_of
from stimrig.identify.methods.maximum_likelihood import METHOD as MAXIMUM_LIKELIHOOD
from stimrig.identify.methods.maximum_likelihood import start
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record

Progress = Callable[[float, str], None]
MOVING_JOINT = ("passive_torque:surface|relaxing", "torque_angle:smooth", "torque_velocity:surface")
"""Effects with which `fit` estimates all of the paper's Fig. 2 together, from joined records: h(x, ẋ), then g(x, ẋ) as
a curve over the angle times a hyperbola over the velocity, both of free shape."""
NO_EFFECTS_WITH = {"monotone", "order"}
"""Options that cannot be combined with effects."""


def fit(
    record: Record,
    method: str = "maximum-likelihood",
    effects: Sequence[str] = (),
    fit_on: Sequence[str] | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Model:
    """Fit a model to a record.

    Parameters
    ----------
    record : Record
        What was measured.
    method : str
        Id of a method, see `identify.methods.methods()`.
    effects : sequence of str
        Ids of effects to add to the Hammerstein model, or "id:form" to choose the form; all are estimated jointly by
        maximum likelihood.
    fit_on : sequence of str, optional
        Names of the segments to fit; by default all but `validate`, or those that the method needs.
    progress : callable, optional
        Called with the share done, 0 to 1, and a line of text while effects are fitted. It may raise `Cancelled`.
    **options
        Options of the method: see `identify.methods.methods()[id].options`.

    Raises
    ------
    BadRequest
        An unknown method, effect, segment or option, or a combination that is not possible.
    BadRecord
        The record is too short, or sampled more slowly than the pulses.
    NotIdentifiable
        The record does not determine the model.
    """
    names = None if fit_on is None else (fit_on,) if isinstance(fit_on, str) else tuple(fit_on)
    if names is not None and not names:
        raise BadRequest("no segment is named", place="fit_on", fix="Name segments, or leave out fit_on.")
    chosen = method_of(method)
    chosen.check_options(options)
    wanted = [effects] if isinstance(effects, str) else list(effects or ())
    twice = {name for name in wanted if wanted.count(name) > 1}
    if twice or not all(isinstance(name, str) for name in wanted):
        listed = ", ".join(map(str, sorted(twice, key=str) or wanted))
        raise BadRequest(f"not a list of different effects: {listed}", place="effects", fix="Name each effect once.")
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            against = [method] if chosen is not MAXIMUM_LIKELIHOOD else sorted(set(options) & NO_EFFECTS_WITH)
            if wanted and against:
                message = f"effects cannot be fitted with {' and '.join(against)}"
                raise BadRequest(message, place="effects", fix="Use maximum-likelihood without this option.")
            of_order = options.get("order", "second-order") != "second-order"
            if len(record.parts) > 1 and (chosen is not MAXIMUM_LIKELIHOOD or of_order):
                taker = "another order" if of_order else method
                message = f"{taker} takes a single recording; this record has {len(record.parts)} parts"
                raise BadRequest(message, place="method", fix="Use maximum-likelihood, or give one of the parts.")
            grid, raw = prepare(record)
            if not wanted:
                return chosen.fit(grid, names, **options)
            rows = fitted_rows(grid, names)
            report = progress or (lambda _share, _text: None)
            return _fit_effects(grid, raw, wanted, rows, options, report)
    except np.linalg.LinAlgError as error:
        fix = "Check that torque follows the pulses."
        raise NotIdentifiable(f"{method} finds no solution on this record ({error})", fix=fix) from error
    except (TypeError, ValueError) as error:
        if options:
            listed = ", ".join(f"{key}={value}" for key, value in options.items())
            raise BadRequest(f"invalid option ({error})", place=listed, fix="See the options of the method.") from error
        raise


def _fit_effects(
    grid: Grid, raw: Raw, wanted: Sequence[str], rows: np.ndarray, options: dict[str, Any], progress: Progress
) -> Model:
    """Maximum likelihood with the named effects, each in its most likely form or in the one given after a colon."""
    for name in wanted:
        find_effect(name.partition(":")[0])  # an unknown one is refused before anything is fitted
    base, reasons = start(grid, rows, options)
    steps = count(1)

    def report(effect: str) -> None:
        progress(min(next(steps), len(wanted)) / (len(wanted) + 2), f"fitting {find_effect(effect).name.lower()}")

    base = add_effects(base, wanted, raw, report)
    reasons = [reasons[0], *words(base, rows)]  # the effects have changed the noise
    if "knots" not in options and (renewed := renewed_curve(base)) is not base:
        base, size = renewed, renewed.problem.setup.basis.size
        reasons[0] = f"spline of {size} coefficients, chosen again with the rows in which the joint moves"
    progress((len(wanted) + 1) / (len(wanted) + 2), "bands and tests of the residual")
    model = finish(MAXIMUM_LIKELIHOOD.id, base, reasons)
    progress(1.0, "done")
    return model
