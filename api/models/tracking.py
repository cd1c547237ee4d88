"""Limits of a tracked model around the approved one, the request for a new test beyond them, and words on trials."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from stimrig.api.clock import local_day
from stimrig.api.local_time import clock, day, when

USUAL_PERCENT = 20.0
QUANTITIES = {"gain": "gain", "threshold_shift_us": "threshold", "time_scale": "time scale"}
"""The quantities of `stimrig.identify.tracking`, named here, too, so that the service need not load it, and what people
read."""
MIDDLES = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0}
"""Their values for the approved model."""
CONTRADICTS, NO_TORQUE, NOT_FOLLOWED = "contradicts", "no-torque", "not-followed"
NEW_TEST = "A new test is needed; the shortest is the adaptive test, which stops by itself."

Bounds = dict[str, tuple[float, float]]
"""Least and most of each quantity that may move, in its own unit; a quantity that may not is left out."""
Percent = Annotated[FiniteFloat, Field(ge=0.0, le=60.0)]


class Limits(BaseModel):
    """How far a tracked model may move from the approved one, either way, 0 to 60 %; 0: this stays as approved."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    gain_percent: Percent = Field(default=USUAL_PERCENT, description="of the gain")
    threshold_percent: Percent = Field(
        default=USUAL_PERCENT, description="of the threshold: the width at which the curve has gone 5 % of its way"
    )
    time_scale_percent: Percent = Field(default=USUAL_PERCENT, description="of the time scale")

    @property
    def allows(self) -> bool:
        """Return whether anything may be tracked."""
        return any(percent > 0.0 for percent in self.model_dump().values())

    def bounds(self, threshold_us: float | None) -> Bounds:
        """Return the bounds of the quantities.

        `threshold_us`: the threshold of the approved curve, µs; without one the threshold is not tracked.
        """
        shift_us = self.threshold_percent / 100.0 * max(threshold_us or 0.0, 0.0)
        halves = (self.gain_percent / 100.0, shift_us, self.time_scale_percent / 100.0)
        around = zip(MIDDLES.items(), halves, strict=True)
        return {name: (middle - half, middle + half) for (name, middle), half in around if half > 0.0}

    def alarms(self, threshold_us: float | None) -> Bounds:
        """Return the bounds beyond which a new test is requested; quantities that are not tracked have the usual ones.

        The muscle changes all the same where the model is held.
        """
        return Limits(**{name: percent or USUAL_PERCENT for name, percent in self.model_dump().items()}).bounds(
            threshold_us
        )


def new_test_reason(number: int, step: Mapping[str, Any], bounds: Bounds) -> str | None:
    """Return why a new test is needed after a trial; None where the next trial is expected within the bounds.

    The bounds are for what is expected, not for its band.

    `number`: of the trial; `step`: `identify.tracking.Step.to_dict()`; `bounds`: beyond these a person is asked
    (`Limits.alarms`).
    """
    words = None
    if step["outcome"] == NO_TORQUE:
        words = (
            f"In trial {number} the pulses gave next to no torque. Look at the electrodes and cables; if they are in "
            "place:"
        )
    elif step["outcome"] == CONTRADICTS:
        times = step["error_nm"] / step["expected_error_nm"]
        words = (
            f"Trial {number} contradicts the structure of the approved model: its error is {times:.1f} times the "
            "expected one, whatever the gain, threshold and time scale are."
        )
    else:
        for name, (low, high) in bounds.items():
            value = step["coming"][name]["value"]
            if value is None or not math.isfinite(value):
                words = f"After trial {number} it is unknown what to expect of the {QUANTITIES[name]}."
            elif not (low <= value <= high):
                words = f"After trial {number} the {QUANTITIES[name]} is expected {_beyond(name, value, low, high)}"
            if words:
                break
    return words and f"{words} {NEW_TEST}"


def _beyond(name: str, value: float, low: float, high: float) -> str:
    """Describe a value beyond its limits; where rounding would show the limit itself, as "just beyond"."""
    if name == "threshold_shift_us":
        moved, upper = f"{value:+.1f}", f"{high:.3g}"
        if abs(float(moved)) <= float(upper):
            return f"just beyond the {upper} µs that it may move."
        return f"to have moved by {moved} µs; {upper} µs either way are allowed."
    percent, lower, upper = f"{100.0 * value:.1f}", f"{100.0 * low:g}", f"{100.0 * high:g}"
    if float(lower) <= float(percent) <= float(upper):
        return f"just beyond the {lower} to {upper} % of the approved one that are allowed."
    return f"to be {percent} % of the approved one; {lower} to {upper} % are allowed."


def not_followed(number: int) -> str:
    """Return why a new test is needed after two consecutive trials that could not be followed."""
    return (
        f"Trials {number - 1} and {number} could not be followed; their table says why. Whether the model still holds "
        f"is not known. {NEW_TEST}"
    )


OUTCOMES = {
    "followed": "followed",
    "little": "too little to learn from",
    "odd": "unlike the trials before; the model hardly moved",
    CONTRADICTS: "does not fit the model",
    NO_TORQUE: "next to no torque came: look at electrodes and cables",
    NOT_FOLLOWED: "not followed",
}
CHANGES = {
    "gain": ("plateau", "lower", "higher"),
    "threshold_shift_us": ("threshold", "lower", "higher"),
    "time_scale": ("muscle", "faster", "slower"),
}
"""What a quantity describes, and the words for less and for more of it."""
NARROW = {"gain": 0.05, "threshold_shift_us": 5.0, "time_scale": 0.1}
"""The muscle is called unchanged where each band holds the middle and leaves it by no more than this."""


def sentences(trials: Sequence[Mapping[str, Any]], since_utc: str) -> list[str]:
    """Describe the changes up to the newest trial that moved the model, where its bands exclude no change.

    `trials`: as `stimrig.api.models.tracked.trial_document` gives them, the oldest first; `since_utc`: when the
    recording of the approved model was made.
    """
    known = [trial for trial in trials if trial["now"] and trial["distance"] is not None]
    if not known:
        return []
    number, now = known[-1]["number"], known[-1]["now"]
    same_day, time = local_day(since_utc) == local_day(known[-1]["at_utc"]), clock(since_utc)[:5]
    day_of_month, _, month = day(since_utc).partition(" ")
    than = f"at {time}" if same_day else f"on {day_of_month} {month} at {time}"
    changes = []
    for name, (what, less, more) in CHANGES.items():
        value, middle = now[name]["value"], MIDDLES[name]
        change = f"{abs(value):.1f} µs" if name == "threshold_shift_us" else _percent(value)
        if now[name]["high"] < middle or now[name]["low"] > middle:
            way = less if now[name]["high"] < middle else more
            changes.append(f"In trial {number} the {what} is {change} {way} than {than}.")
    if changes:
        return changes
    ends = [(abs(now[name][end] - MIDDLES[name]), NARROW[name]) for name in MIDDLES for end in ("low", "high")]
    if all(distance <= narrow for distance, narrow in ends):
        return [f"In trial {number} the muscle is as it was {than}."]
    return [f"By trial {number} no change since {time if same_day else when(since_utc)} is certain."]


def _percent(factor: float) -> str:
    change = abs(100.0 * (factor - 1.0))
    return f"{change:.0f} %" if change >= 9.5 else f"{change:.1f} %"
