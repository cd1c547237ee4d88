"""The option `recruitment=near-sigmoid`: a curve that never falls, near a sigmoid or near the person's last curve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from identify.dynamics.pulse_grid import Grid
from identify.errors import BadRequest
from identify.estimation.averaged import averaged
from identify.estimation.earlier import Change, Earlier
from identify.estimation.joint import Fitted
from identify.estimation.short_record import fit_short
from identify.estimation.short_result import Short
from identify.model import Model
from identify.recruitment.near_shape import DEVIATIONS

DRAWS = 1500
OWN = {"recruitment", "earlier", "order"}


def near_sigmoid(grid: Grid, rows: np.ndarray, options: Mapping[str, Any]) -> tuple[Fitted, list[str]]:
    """The fit, and why the curve is as it is.

    Raises
    ------
    BadRequest
        Options that belong to another kind of curve, or an earlier model that is none.
    """
    others = sorted(set(options) - OWN)
    if others or options.get("recruitment", "near-sigmoid") != "near-sigmoid":
        against = ", ".join(others) or f"recruitment={options['recruitment']}"
        raise BadRequest(f"not with {against}", place="recruitment", fix="Give near-sigmoid, and earlier or nothing.")
    model = options.get("earlier")
    if model is not None and not isinstance(model, Model):
        raise BadRequest("not a model", place="earlier", fix="Give the person's last model, or none.")
    last = None if model is None else Earlier(model, Change())
    short = fit_short(grid, rows, last=last, fine=True, draws=DRAWS)
    return averaged(short), [_why(short, last)]


def _why(short: Short, last: Earlier | None) -> str:
    if last is not None:
        return "a curve that never falls, near that of the last model"
    kind = DEVIATIONS[int(np.argmax(short.weights))]
    return f"a curve that never falls; its slope is a sigmoid's times a factor of {np.exp(kind.sd):.1f} or less, mostly"
