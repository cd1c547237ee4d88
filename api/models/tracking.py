"""How far a tracked model may move from the approved one, by what a person allowed, and what is said beyond that."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from api.errors import ApiError

LEAST_PERCENT, MOST_PERCENT, USUAL_PERCENT = 0.0, 60.0, 20.0
QUANTITIES = ("gain", "threshold_shift_us", "time_scale")
"""As `identify.tracking` has them; named here, too, so that the service need not load it."""
CONTRADICTS, NOT_FOLLOWED = "contradicts", "not-followed"
NEW_TEST = "A new test is needed; the shortest is the adaptive test, which stops by itself."

Bounds = dict[str, tuple[float, float]]
"""Least and most of each quantity that may move, in its own unit; a quantity that may not is left out."""


@dataclass(frozen=True)
class Limits:
    """Each in percent, 0 to 60; 0: this is not tracked.

    Parameters
    ----------
    gain_percent : float
        Of the approved gain, either way.
    threshold_percent : float
        Of the approved curve's threshold, the pulse width at which it has gone 5 % of its way to the plateau.
    time_scale_percent : float
        Of the approved time constant, either way.

    Raises
    ------
    ApiError
        422: outside of that.
    """

    gain_percent: float = USUAL_PERCENT
    threshold_percent: float = USUAL_PERCENT
    time_scale_percent: float = USUAL_PERCENT

    def __post_init__(self) -> None:
        given = self.to_dict()
        if wrong := [name for name, percent in given.items() if not (LEAST_PERCENT <= percent <= MOST_PERCENT)]:
            detail = f"{', '.join(wrong)}: give {LEAST_PERCENT:g} to {MOST_PERCENT:g} %. Nothing was decided."
            raise ApiError(422, "invalid-input", "These limits of tracking cannot be used", detail)

    @property
    def allows(self) -> bool:
        """Whether anything may be tracked."""
        return any(percent > 0.0 for percent in self.to_dict().values())

    def to_dict(self) -> dict[str, float]:
        """As JSON."""
        return asdict(self)

    def bounds(self, threshold_us: float | None) -> Bounds:
        """What the quantities may be.

        Parameters
        ----------
        threshold_us : float or None
            The approved curve's threshold, µs; without one the threshold is not tracked.
        """
        gain, time_scale = self.gain_percent / 100.0, self.time_scale_percent / 100.0
        shift_us = self.threshold_percent / 100.0 * max(threshold_us or 0.0, 0.0)
        around = {"gain": (1.0, gain), "threshold_shift_us": (0.0, shift_us), "time_scale": (1.0, time_scale)}
        return {name: (middle - half, middle + half) for name, (middle, half) in around.items() if half > 0.0}


def ask(number: int, step: Mapping[str, Any], bounds: Bounds) -> str | None:
    """Why a person has to be asked after a trial; None where the next one is expected within the bounds.

    Parameters
    ----------
    number : int
        Of the trial.
    step : mapping
        `identify.tracking.Step.to_dict()`.
    bounds : Bounds
        What a person allowed.
    """
    if step["outcome"] == CONTRADICTS:
        times = step["error_nm"] / step["expected_error_nm"]
        words = (
            f"Trial {number} contradicts the structure of the approved model: its error is {times:.1f} times the "
            "expected one, whatever the gain, threshold and time scale are."
        )
        return " ".join((words, NEW_TEST))
    found = {name: step["coming"][name]["value"] for name in QUANTITIES}
    values = {name: math.nan if value is None else float(value) for name, value in found.items()}
    for name, (low, high) in bounds.items():
        if not (low <= values[name] <= high):
            return " ".join((_left(number, name, values[name], low, high), NEW_TEST))
    return None


def _left(number: int, name: str, value: float, low: float, high: float) -> str:
    percent, least, most = 100.0 * value, 100.0 * low, 100.0 * high
    if name == "gain":
        return (
            f"After trial {number} the gain is expected to be {percent:.1f} % of the approved one; {least:.0f} to "
            f"{most:.0f} % are allowed."
        )
    if name == "time_scale":
        return (
            f"After trial {number} the time constant is expected to be {percent:.1f} % of the approved one; "
            f"{least:.0f} to {most:.0f} % are allowed."
        )
    return (
        f"After trial {number} the threshold is expected to have moved by {value:+.1f} µs; {high:.1f} µs either way "
        "are allowed."
    )
