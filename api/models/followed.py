"""The one figure that says how good a model is, the same on every page: on new pulses where it exists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from api.language import _


@dataclass(frozen=True)
class Followed:
    """How much of the torque a model follows.

    Parameters
    ----------
    percent, ceiling_percent : float or None
        Best fit, and the most that the sensor noise allows on the same pulses; None where it is not defined.
    where : str
        The pulses it was found on, as the beginning of a sentence.
    """

    percent: float | None
    ceiling_percent: float | None
    where: str


def followed(fit: Mapping[str, Any]) -> Followed:
    """The figure of a model's `fit`: of pulses not used for fitting where there are any."""
    if fit.get("held_out_fit_percent") is None:
        where = _("On the pulses that it was fitted to")
        return Followed(fit.get("fit_percent"), fit.get("ceiling_percent"), where)
    if fit.get("held_out_by") == "cross-validation":
        where = _("On parts of the recording that were left out in turn")
    else:
        where = _("On pulses not used for fitting")
    return Followed(fit["held_out_fit_percent"], fit.get("held_out_ceiling_percent"), where)
