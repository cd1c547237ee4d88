"""The front door to every method: a record in, a model out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from identify.grid import make_grid
from identify.methods import known_options, method_of
from identify.model import Model
from identify.record import Record


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
        Of the method; `identify.methods()[id].options` tells.

    Raises
    ------
    BadRequest, BadRecord, NotIdentifiable
    """
    names = None if fit_on is None else tuple(fit_on)
    if effects:
        from identify.engine import fit_with_effects  # type: ignore[import-not-found]

        return fit_with_effects(record, list(effects), fit_on=names, **options)
    chosen = method_of(method)
    known_options(chosen, options)
    return chosen.fit(make_grid(record), names, **options)
