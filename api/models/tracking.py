"""Limits of a tracked model around the approved one, the request for a new test beyond them, and words on trials."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from stimrig.api.local_time import when

USUAL_PERCENT = 20.0
MIDDLES = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0}
"""The quantities of `stimrig.identify.tracking` and their values for the approved model; named here, too, so that the
service need not load it."""
QUANTITIES = {"gain": "gain", "threshold_shift_us": "threshold", "time_scale": "time scale"}
CONTRADICTS, NO_TORQUE, NOT_FOLLOWED = "contradicts", "no-torque", "not-followed"
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
"""Subject of each quantity, and the words for less and for more of it."""
NEW_TEST = "A new test is needed; the shortest is the adaptive test, which stops by itself."

Bounds = dict[str, tuple[float, float]]
"""Least and most of each quantity that may move, in its own unit; a quantity that may not is left out."""
Percent = Annotated[FiniteFloat, Field(ge=0.0, le=60.0)]


class Limits(BaseModel):
    """Limits on a tracked model's distance from the approved one, either way, 0 to 60 %; 0: this stays as approved."""

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
        watched = {name: percent or USUAL_PERCENT for name, percent in self.model_dump().items()}
        return Limits(**watched).bounds(threshold_us)


def limits_words(limits: Mapping[str, float] | None, threshold_us: float | None) -> str:
    """Say in a sentence how far a model is tracked. `limits`: fields of `Limits`; None: the usual ones."""
    allowed = Limits(**(limits or {}))
    bounds = allowed.bounds(threshold_us)
    if not bounds:
        return "The model does not follow the muscle from trial to trial: all stays as approved."
    parts = []
    for (name, words), percent in zip(QUANTITIES.items(), allowed.model_dump().values(), strict=True):
        shift = f" (±{bounds[name][1]:.3g}\u00a0µs)" if name in bounds and name == "threshold_shift_us" else ""
        parts.append(f"{words} ±{percent:g}\u00a0%{shift}" if name in bounds else f"{words} as approved")
    return f"The model follows the muscle from trial to trial, at most: {', '.join(parts)}."


def new_test_reason(number: int, step: Mapping[str, Any], bounds: Bounds) -> str | None:
    """Return why a new test is needed after a trial; None where the next trial is expected within the bounds.

    The bounds are for what is expected, not for its band.

    `number`: of the trial; `step`: `identify.tracking.Step.to_dict()`; `bounds`: `Limits.alarms`.
    """
    if step["outcome"] == NO_TORQUE:
        words = f"In trial {number} the pulses gave next to no torque. Look at the electrodes and cables; if they are "
        return f"{words}in place: {NEW_TEST}"
    if step["outcome"] == CONTRADICTS:
        times = step["error_nm"] / step["expected_error_nm"]
        return (
            f"Trial {number} contradicts the structure of the approved model: its error is {times:.1f} times the "
            f"expected one, whatever the gain, threshold and time scale are. {NEW_TEST}"
        )
    for name, (low, high) in bounds.items():
        value = step["coming"][name]["value"]
        if value is None or not math.isfinite(value):
            return f"After trial {number} it is unknown what to expect of the {QUANTITIES[name]}. {NEW_TEST}"
        if not low <= value <= high:
            words = f"be {100.0 * value:.2f} % of the approved one; {100.0 * low:g} to {100.0 * high:g} % are allowed."
            if name == "threshold_shift_us":
                words = f"have moved by {value:+.2f} µs; {high:.2f} µs either way are allowed."
            return f"After trial {number} the {QUANTITIES[name]} is expected to {words} {NEW_TEST}"
    return None


def not_followed(number: int) -> str:
    """Return why a new test is needed after two consecutive trials that could not be followed."""
    return (
        f"Trials {number - 1} and {number} could not be followed; their table says why. Whether the model still holds "
        f"is not known. {NEW_TEST}"
    )


def sentences(trials: Sequence[Mapping[str, Any]], since_utc: str) -> list[str]:
    """Describe the changes up to the newest trial that moved the model, where its bands exclude no change.

    `trials`: as `stimrig.api.models.tracked.trial_document` gives them, the oldest first; `since_utc`: when the
    recording of the approved model was made.
    """
    followed = [trial for trial in trials if trial["now"] and trial["distance"] is not None]
    if not followed:
        return []
    number, now, since = followed[-1]["number"], followed[-1]["now"], when(since_utc)
    changes = []
    for name, (what, less, more) in CHANGES.items():
        level, middle = now[name], MIDDLES[name]
        percent = abs(100.0 * (level["value"] - middle))
        change = f"{percent / 100.0:.1f} µs" if name == "threshold_shift_us" else f"{percent:.1f} %"
        if level["high"] < middle or level["low"] > middle:
            way = less if level["high"] < middle else more
            changes.append(f"In trial {number} the {what} is {change} {way} than on {since}.")
    return changes or [f"By trial {number} no change since {since} is certain."]
