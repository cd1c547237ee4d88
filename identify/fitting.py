"""The front door to every method: a record in, a model out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from identify.dynamics.pulse_grid import Grid, make_grid
from identify.errors import BadRequest, NotIdentifiable
from identify.methods import known_options, method_of
from identify.model import Model
from identify.records.record import Record

LEAST_ROWS = 8


def fit(
    record: Record,
    method: str = "maximum-likelihood",
    effects: Sequence[str] = (),
    fit_on: Sequence[str] | None = None,
    **options: Any,
) -> Model:
    """Fit a model to a record.

    Parameters
    ----------
    record : Record
        What was measured.
    method : str
        Id of a method.
    effects : sequence of str
        Ids of effects to add around the Hammerstein core; estimated jointly by maximum likelihood.
    fit_on : sequence of str, optional
        Names of the segments to fit on; by default all but `validate`, or what the method needs.
    **options
        Of the method; `identify.methods.methods()[id].options` tells.

    Raises
    ------
    BadRequest, BadRecord, NotIdentifiable
    """
    names = None if fit_on is None else tuple(fit_on)
    if effects:
        from identify.estimation.with_effects import fit_with_effects  # type: ignore[import-not-found]

        return fit_with_effects(record, list(effects), fit_on=names, **options)
    chosen = method_of(method)
    known_options(chosen, options)
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            grid = make_grid(record)
            refuse_stillness(grid)
            return chosen.fit(grid, names, **options)
    except np.linalg.LinAlgError as error:
        raise NotIdentifiable(
            f"{method} finds no solution on this record ({error})", mend="Check that torque follows the pulses."
        ) from error
    except (TypeError, ValueError) as error:
        if options:
            given = ", ".join(f"{key}={value}" for key, value in options.items())
            raise BadRequest(f"unusable option ({error})", place=given, mend="See the method's options.") from error
        raise


def refuse_stillness(grid: Grid) -> None:
    """Refuse a record in which nothing happens.

    Raises
    ------
    NotIdentifiable
        Nothing may be fitted, there is no pulse, or the torque never changes.
    """
    if grid.fitted.sum() < LEAST_ROWS:
        raise NotIdentifiable(
            f"only {int(grid.fitted.sum())} pulse intervals may be fitted",
            mend="Give rows of segments other than `validate`.",
        )
    if not np.max(grid.pulse_width_us[grid.fitted]) > 0:
        raise NotIdentifiable("no pulse is in the record", mend="Record a PRBS and a ramp.")
    if not np.ptp(grid.torque_nm[grid.fitted]) > 0:
        raise NotIdentifiable("the torque never changes", mend="Check the load cell and the electrodes.")
