"""What an adaptive test must reach before it stops."""

from __future__ import annotations

from dataclasses import dataclass

from stimrig.identify.errors import BadRequest

LEAST_PERCENT, MOST_PERCENT = 0.2, 50.0


@dataclass(frozen=True)
class Target:
    """Largest half-widths of the 95 % bands of whole curves.

    Parameters
    ----------
    curve_percent : float
        Of the recruitment curve f(u), as a share of its plateau, %.
    step_percent : float
        Of the response to a unit step, %.

    Raises
    ------
    BadRequest
        Not a number from 0.2 to 50.
    """

    curve_percent: float = 2.0
    step_percent: float = 2.0

    def __post_init__(self) -> None:
        for name in ("curve_percent", "step_percent"):
            value = getattr(self, name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not (number and LEAST_PERCENT <= value <= MOST_PERCENT):
                raise BadRequest(
                    f"{value!r} is no target",
                    place=f"target.{name}",
                    fix=f"Give a number from {LEAST_PERCENT:g} to {MOST_PERCENT:g} %.",
                )
