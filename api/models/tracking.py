"""How far a tracked model may move from the approved one, what is said beyond that, and what trials said."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from stimrig.api.clock import local_day
from stimrig.api.errors import ApiError
from stimrig.api.local_time import clock, day, when

LEAST_PERCENT, MOST_PERCENT, USUAL_PERCENT = 0.0, 60.0, 20.0
QUANTITIES = {"gain": "gain", "threshold_shift_us": "threshold", "time_scale": "time scale"}
"""The quantities of `stimrig.identify.tracking`, named here, too, so that the service need not load it, and what people
read."""
CONTRADICTS, NO_TORQUE, NOT_FOLLOWED = "contradicts", "no-torque", "not-followed"
NEW_TEST = "A new test is needed; the shortest is the adaptive test, which stops by itself."

Bounds = dict[str, tuple[float, float]]
"""Least and most of each quantity that may move, in its own unit; a quantity that may not is left out."""


@dataclass(frozen=True)
class Limits:
    """Each in percent, 0 to 60; 0: this stays as approved. Raises ApiError: 422: outside of that."""

    gain_percent: float = USUAL_PERCENT  # of the approved gain, either way
    threshold_percent: float = USUAL_PERCENT
    """Of the approved curve's threshold, the pulse width at which it has gone 5 % of its way to the plateau."""
    time_scale_percent: float = USUAL_PERCENT  # of the approved model's time scale, either way

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

        `threshold_us`: the approved curve's threshold, µs; without one the threshold is not tracked.
        """
        gain, time_scale = self.gain_percent / 100.0, self.time_scale_percent / 100.0
        shift_us = self.threshold_percent / 100.0 * max(threshold_us or 0.0, 0.0)
        around = {"gain": (1.0, gain), "threshold_shift_us": (0.0, shift_us), "time_scale": (1.0, time_scale)}
        return {name: (middle - half, middle + half) for name, (middle, half) in around.items() if half > 0.0}

    def alarms(self, threshold_us: float | None) -> Bounds:
        """Beyond what a person is asked: the bounds, and the usual ones of what stays as approved.

        The muscle changes all the same where the model is held.
        """
        return Limits(*(percent or USUAL_PERCENT for percent in self.to_dict().values())).bounds(threshold_us)


def ask(number: int, step: Mapping[str, Any], bounds: Bounds) -> str | None:
    """Why a person has to be asked after a trial; None where the next one is expected within the bounds.

    The bounds are for what is expected, not for its band.

    `number`: of the trial; `step`: `identify.tracking.Step.to_dict()`; `bounds`: beyond these a person is asked
    (`Limits.alarms`).
    """
    words = _outcome_sentence(number, step) or _beyond(number, step["coming"], bounds)
    return f"{words} {NEW_TEST}" if words else None


def not_followed(number: int) -> str:
    """Why a person has to be asked after two trials running that could not be followed."""
    before = number - 1
    words = (
        f"Trials {before} and {number} could not be followed; their table says why. Whether the model still holds is "
        "not known."
    )
    return f"{words} {NEW_TEST}"


def _outcome_sentence(number: int, step: Mapping[str, Any]) -> str | None:
    if step["outcome"] == NO_TORQUE:
        return (
            f"In trial {number} the pulses gave next to no torque. Look at the electrodes and cables; if they are in "
            "place:"
        )
    if step["outcome"] == CONTRADICTS:
        times = step["error_nm"] / step["expected_error_nm"]
        return (
            f"Trial {number} contradicts the structure of the approved model: its error is {times:.1f} times the "
            "expected one, whatever the gain, threshold and time scale are."
        )
    return None


def _beyond(number: int, coming: Mapping[str, Any], bounds: Bounds) -> str | None:
    """What is expected outside of its bounds; what is no number is."""
    for name, (low, high) in bounds.items():
        value = coming[name]["value"]
        if value is None or not math.isfinite(value):
            return _unknown(number, name)
        if not (low <= value <= high):
            return _left(number, name, float(value), low, high)
    return None


def _unknown(number: int, name: str) -> str:
    return f"After trial {number} it is unknown what to expect of the {QUANTITIES[name]}."


def _left(number: int, name: str, value: float, low: float, high: float) -> str:
    """Where rounding would write the limit itself, the sentence says "just beyond" instead of a number."""
    if name == "threshold_shift_us":
        moved, most = f"{value:+.1f}", f"{high:.3g}"
        if abs(float(moved)) <= float(most):
            return f"After trial {number} the threshold is expected just beyond the {most} µs that it may move."
        return (
            f"After trial {number} the threshold is expected to have moved by {moved} µs; {most} µs either way are "
            "allowed."
        )
    what, percent, least, most = QUANTITIES[name], f"{100.0 * value:.1f}", f"{100.0 * low:g}", f"{100.0 * high:g}"
    if float(least) <= float(percent) <= float(most):
        return (
            f"After trial {number} the {what} is expected just beyond the {least} to {most} % of the approved one that "
            "are allowed."
        )
    return (
        f"After trial {number} the {what} is expected to be {percent} % of the approved one; {least} to {most} % are "
        "allowed."
    )


OUTCOMES = {
    "followed": "followed",
    "little": "too little to learn from",
    "odd": "unlike the trials before; the model hardly moved",
    "contradicts": "does not fit the model",
    "no-torque": "next to no torque came: look at electrodes and cables",
    "not-followed": "not followed",
}
SENTENCES = {
    "gain": (
        "In trial %(number)s the plateau is %(change)s lower than %(than)s.",
        "In trial %(number)s the plateau is %(change)s higher than %(than)s.",
    ),
    "threshold_shift_us": (
        "In trial %(number)s the threshold is %(change)s lower than %(than)s.",
        "In trial %(number)s the threshold is %(change)s higher than %(than)s.",
    ),
    "time_scale": (
        "In trial %(number)s the muscle is %(change)s faster than %(than)s.",
        "In trial %(number)s the muscle is %(change)s slower than %(than)s.",
    ),
}
"""Lower or faster, higher or slower: for the catalogues, and for `_`."""
MIDDLES = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0}
NARROW = {"gain": 0.05, "threshold_shift_us": 5.0, "time_scale": 0.1}
"""The muscle is called unchanged where each band holds the middle and leaves it by no more than this."""


def sentences(trials: Sequence[Mapping[str, Any]], since_utc: str) -> list[str]:
    """What has changed by the newest trial that the model learnt from; only what its bands are sure of.

    `trials`: as `stimrig.api.models.tracked.trial_document` gives them, the oldest first; `since_utc`: when the
    approved model's recording was made.
    """
    known = [trial for trial in trials if trial["now"] and trial["distance"] is not None]
    if not known:
        return []
    now, last = known[-1]["now"], known[-1]["at_utc"]
    same_day = local_day(since_utc) == local_day(last)
    said = {"number": known[-1]["number"], "than": _than(since_utc, same_day)}
    found = []
    for name, (lower, higher) in SENTENCES.items():
        if sign := _sure(now, name):
            value = now[name]["value"]
            shift = name == "threshold_shift_us"
            change = f"{abs(value):.1f} µs" if shift else _percent(value)
            found.append((lower if sign < 0 else higher) % {"change": change, **said})
    if found:
        return found
    if all(_narrow(now, name) for name in MIDDLES):
        return ["In trial {number} the muscle is as it was {than}.".format(**said)]
    since = clock(since_utc)[:5] if same_day else when(since_utc)
    return [f"By trial {said['number']} no change since {since} is certain."]


def _than(since_utc: str, same_day: bool) -> str:
    time = clock(since_utc)[:5]
    if same_day:
        return f"at {time}"
    number, __, month = day(since_utc).partition(" ")
    return f"on {number} {month} at {time}"


def _sure(now: Mapping[str, Mapping[str, float]], name: str) -> int:
    """-1 or 1 where the whole band is below or above the middle; 0 where it is neither."""
    return int(now[name]["low"] > MIDDLES[name]) - int(now[name]["high"] < MIDDLES[name])


def _narrow(now: Mapping[str, Mapping[str, float]], name: str) -> bool:
    ends = (now[name]["low"], now[name]["high"])
    return all(abs(end - MIDDLES[name]) <= NARROW[name] for end in ends)


def _percent(factor: float) -> str:
    change = abs(100.0 * (factor - 1.0))
    return f"{change:.0f} %" if change >= 9.5 else f"{change:.1f} %"
