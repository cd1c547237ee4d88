"""What trials said of the muscle, in sentences for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from api.clock import local_day
from api.language import _, clock, lazy, localised, when

OUTCOMES = {
    "followed": lazy("followed"),
    "little": lazy("tells little"),
    "odd": lazy("odd, moves little"),
    "contradicts": lazy("does not fit the model"),
    "not-followed": lazy("not followed"),
}


def sentences(trials: Sequence[Mapping[str, Any]], since_utc: str) -> list[str]:
    """What has changed by the newest trial that was followed; only what its bands are sure of.

    Parameters
    ----------
    trials : sequence of mapping
        As `api.models.tracked.told` gives them, the oldest first.
    since_utc : str
        When the approved model's recording was made.
    """
    known = [trial for trial in trials if trial["now"] and trial["outcome"] != "contradicts"]
    if not known:
        return []
    now, last = known[-1]["now"], known[-1]["at_utc"]
    same_day = local_day(since_utc) == local_day(last)
    time = clock(since_utc)[:5] if same_day else when(since_utc)
    found = []
    if sign := _sure(now["gain"], 1.0):
        change = _percent(now["gain"]["value"])
        lower = _("The plateau is %(change)s lower than at %(time)s.", change=change, time=time)
        higher = _("The plateau is %(change)s higher than at %(time)s.", change=change, time=time)
        found.append(lower if sign < 0 else higher)
    if sign := _sure(now["threshold_shift_us"], 0.0):
        change = localised(f"{abs(now['threshold_shift_us']['value']):.1f} µs")
        lower = _("The threshold is %(change)s lower than at %(time)s.", change=change, time=time)
        higher = _("The threshold is %(change)s higher than at %(time)s.", change=change, time=time)
        found.append(lower if sign < 0 else higher)
    if sign := _sure(now["time_scale"], 1.0):
        change = _percent(now["time_scale"]["value"])
        faster = _("The muscle is %(change)s faster than at %(time)s.", change=change, time=time)
        slower = _("The muscle is %(change)s slower than at %(time)s.", change=change, time=time)
        found.append(faster if sign < 0 else slower)
    return found or [_("The muscle is as it was at %(time)s.", time=time)]


def _sure(level: Mapping[str, float], middle: float) -> int:
    """-1 or 1 where the whole band is below or above; 0 where it is neither."""
    return int(level["low"] > middle) - int(level["high"] < middle)


def _percent(factor: float) -> str:
    change = abs(100.0 * (factor - 1.0))
    return localised(f"{change:.0f} %" if change >= 9.5 else f"{change:.1f} %")
