"""The trend in words: names of figures, what changed, and what puts a comparison in doubt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from stimrig.api import language
from stimrig.api.effect_words import effect_words, effects_words, parameter_words
from stimrig.api.language import _, lazy
from stimrig.api.models import changes
from stimrig.api.models.changes import State


@dataclass(frozen=True)
class Name:
    """How a figure is called and shown.

    Parameters
    ----------
    words : str
        Its name.
    unit : str
        The unit it is shown in.
    factor : float
        From the stored unit to that one.
    digits : int or None
        Digits after the point; None: three significant ones.
    in_percent : bool
        Whether a change of it is told in per cent.
    """

    words: Any
    unit: str
    factor: float = 1.0
    digits: int | None = None
    in_percent: bool = False


NAMES = {
    "threshold_us": Name(lazy("Threshold"), "µs", digits=1),
    "plateau_nm": Name(lazy("Plateau"), "N·m", digits=2, in_percent=True),
    "time_constant_s": Name(lazy("Time constant"), "s", digits=3, in_percent=True),
    "damping": Name(lazy("Damping"), "1", digits=3, in_percent=True),
    "delay_s": Name(lazy("Delay"), "ms", 1e3, digits=1),
    "follows_percent": Name(lazy("Follows"), "%", digits=1),
    "noise_sd_nm": Name(lazy("Noise of the torque sensor"), "N·m", digits=3),
    "charge_uc": Name(lazy("Dose (charge)"), "mC", 1e-3, digits=2),
    "current_ma": Name(lazy("Current"), "mA", digits=1),
}
UNBROKEN = "\u00a0"
"""Between a number and its unit no line ends."""
LAST = ("follows_percent", "noise_sd_nm", "charge_uc", "current_ma")
"""Shown after the effects' parameters."""


def name_of(figure: str, unit: str = "1") -> Name:
    """A figure's name; of an effect's parameter, the effect and the parameter without its unit."""
    if figure in NAMES:
        return NAMES[figure]
    effect, _dot, parameter = figure.partition(".")
    return Name(f"{effect_words(effect)}, {parameter_words(parameter)}", unit, in_percent=True)


def shown(value: float | None, name: Name, unit: bool = True) -> str:
    """A value in the unit in which it is shown, as the page's language writes it."""
    if value is None:
        return "–"
    scaled = value * name.factor
    digits = name.digits if name.digits is not None else _digits(scaled)
    text = language.localised(f"{round(scaled, digits) + 0.0:.{digits}f}".replace("-", "−"))  # + 0.0: no "−0"
    return f"{text}{UNBROKEN}{name.unit}" if unit and name.unit != "1" else text


def with_uncertainty(value: float | None, uncertainty: float | None, name: Name, sign: bool = False) -> str:
    """A value with twice its uncertainty, without the unit; a difference has its sign."""
    if uncertainty and name.digits is None:  # as many digits as are known
        name = replace(name, digits=max(0, _digits(changes.BEYOND * uncertainty * name.factor) - 1))
    words = shown(value, name, unit=False)
    if sign and value is not None and not words.startswith("−"):
        words = f"+{words}"
    if value is None or uncertainty is None:
        return words
    return f"{words} ± {shown(changes.BEYOND * uncertainty, name, unit=False)}"


def _digits(value: float) -> int:
    return min(6, max(0, 2 - math.floor(math.log10(abs(value))))) if value else 0


def told(before: State, now: State, since_utc: str) -> list[str]:
    """What changed beyond its uncertainty, a sentence each; one that says so where nothing did."""
    day = language.day(since_utc)
    moved = changes.changed(before, now)
    if not moved:
        return [_("Nothing changed beyond its uncertainty since %(day)s.", day=day)]
    return [sentence(one, day) for one in moved]


def sentence(one: dict[str, Any], day: str) -> str:
    """A change, and how sure it is. Of a falling curve the plateau's size is compared."""
    name = name_of(one["figure"], one["unit"])
    if one["before"] * one["now"] < 0:
        amounts = {"before": shown(one["before"], name), "now": shown(one["now"], name)}
        return _("%(figure)s: %(now)s, it was %(before)s on %(day)s.", figure=name.words, day=day, **amounts)
    lower = abs(one["now"]) < abs(one["before"])
    if name.in_percent and one["percent"] is not None:
        amount = f"{abs(one['percent']):.{1 if abs(one['percent']) < 9.95 else 0}f}{UNBROKEN}%"
    else:
        amount = shown(abs(one["difference"]), name)
    given = {"figure": name.words, "amount": language.localised(amount), "day": day}
    if lower:
        return _("%(figure)s %(amount)s lower than on %(day)s, more than twice its uncertainty.", **given)
    return _("%(figure)s %(amount)s higher than on %(day)s, more than twice its uncertainty.", **given)


def doubted(before: State, now: State) -> list[str]:
    """What puts the comparison in doubt, a sentence each."""
    return [DOUBTS.get(one["kind"], _noted)(one) for one in changes.doubts(before, now)]


def _current(one: dict[str, Any]) -> str:
    given = {side: shown(one[side], NAMES["current_ma"]) for side in ("before", "now")}
    return _("The current was %(before)s, now it is %(now)s: threshold and plateau are not compared.", **given)


def _current_unknown(_one: dict[str, Any]) -> str:
    return _("The current of a recording is not known: threshold and plateau compare only at the same current.")


def _method(one: dict[str, Any]) -> str:
    return _("The methods differ (%(before)s, then %(now)s): only large differences are told.", **_pair(one))


def _effects(one: dict[str, Any]) -> str:
    none = _("none")
    given = {side: effects_words(one[side]) or none for side in ("before", "now")}
    return _("The models' effects differ (%(before)s, then %(now)s): only large differences are told.", **given)


def _noted(one: dict[str, Any]) -> str:
    return _("The notes on %(kind)s differ: “%(before)s”, then “%(now)s”.", kind=KINDS.get(one["kind"], one["kind"]),
             **_pair(one))  # fmt: skip


def _pair(one: dict[str, Any]) -> dict[str, str]:
    return {side: str(one[side] or "–")[:80] for side in ("before", "now")}


KINDS = {"electrodes": lazy("electrodes"), "side": lazy("the side"), "posture": lazy("posture")}
DOUBTS: dict[str, Callable[[dict[str, Any]], str]] = {
    "current": _current,
    "current unknown": _current_unknown,
    "method": _method,
    "effects": _effects,
}
