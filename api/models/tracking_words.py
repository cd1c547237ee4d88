"""What trials said of the muscle, in sentences for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from api.clock import local_day
from api.language import _, clock, day, lazy, localised, when

OUTCOMES = {
    "followed": lazy("followed"),
    "little": lazy("too little to learn from"),
    "odd": lazy("unlike the trials before; the model hardly moved"),
    "contradicts": lazy("does not fit the model"),
    "no-torque": lazy("next to no torque came: look at electrodes and cables"),
    "not-followed": lazy("not followed"),
}
MIDDLES = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0}
NARROW = {"gain": 0.05, "threshold_shift_us": 5.0, "time_scale": 0.1}
"""The muscle is called unchanged where each band holds the middle and leaves it by no more than this."""


def sentences(trials: Sequence[Mapping[str, Any]], since_utc: str) -> list[str]:
    """What has changed by the newest trial that the model learnt from; only what its bands are sure of.

    Parameters
    ----------
    trials : sequence of mapping
        As `api.models.tracked.told` gives them, the oldest first.
    since_utc : str
        When the approved model's recording was made.
    """
    known = [trial for trial in trials if trial["now"] and trial["distance"] is not None]
    if not known:
        return []
    now, last = known[-1]["now"], known[-1]["at_utc"]
    same_day = local_day(since_utc) == local_day(last)
    said = {"number": known[-1]["number"], "than": _than(since_utc, same_day)}
    found = []
    if sign := _sure(now, "gain"):
        said["change"] = _percent(now["gain"]["value"])
        lower = _("In trial %(number)s the plateau is %(change)s lower than %(than)s.", **said)
        higher = _("In trial %(number)s the plateau is %(change)s higher than %(than)s.", **said)
        found.append(lower if sign < 0 else higher)
    if sign := _sure(now, "threshold_shift_us"):
        said["change"] = localised(f"{abs(now['threshold_shift_us']['value']):.1f} µs")
        lower = _("In trial %(number)s the threshold is %(change)s lower than %(than)s.", **said)
        higher = _("In trial %(number)s the threshold is %(change)s higher than %(than)s.", **said)
        found.append(lower if sign < 0 else higher)
    if sign := _sure(now, "time_scale"):
        said["change"] = _percent(now["time_scale"]["value"])
        faster = _("In trial %(number)s the muscle is %(change)s faster than %(than)s.", **said)
        slower = _("In trial %(number)s the muscle is %(change)s slower than %(than)s.", **said)
        found.append(faster if sign < 0 else slower)
    if found:
        return found
    if all(_narrow(now, name) for name in MIDDLES):
        return [_("In trial %(number)s the muscle is as it was %(than)s.", **said)]
    since = clock(since_utc)[:5] if same_day else when(since_utc)
    return [_("By trial %(number)s no change since %(since)s is certain.", number=said["number"], since=since)]


def _than(since_utc: str, same_day: bool) -> str:
    time = clock(since_utc)[:5]
    if same_day:
        return _("at %(time)s", time=time)
    number, __, month = day(since_utc).partition(" ")
    return _("on %(day)s %(month)s at %(time)s", day=number, month=month, time=time)


def _sure(now: Mapping[str, Mapping[str, float]], name: str) -> int:
    """-1 or 1 where the whole band is below or above the middle; 0 where it is neither."""
    return int(now[name]["low"] > MIDDLES[name]) - int(now[name]["high"] < MIDDLES[name])


def _narrow(now: Mapping[str, Mapping[str, float]], name: str) -> bool:
    ends = (now[name]["low"], now[name]["high"])
    return all(abs(end - MIDDLES[name]) <= NARROW[name] for end in ends)


def _percent(factor: float) -> str:
    change = abs(100.0 * (factor - 1.0))
    return localised(f"{change:.0f} %" if change >= 9.5 else f"{change:.1f} %")
