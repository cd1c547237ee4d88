"""Differences between two models of a muscle beyond their uncertainty, in figures and in words, with their doubts.

The standard deviations of both models measure the effect of the two records' noise. On emulated muscles that had not
changed they are right for most figures and too small for some (a curve's bend between two knots, an effect that no
model holds). So a floor is added to them; docs/results/trend.md says how it was measured.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from stimrig.api import local_time
from stimrig.api.effect_words import effect_words, effects_words, fact_of, parameter_words
from stimrig.api.models.stored_model import Figure

BEYOND = 2.0
"""A change is reported above this multiple of its uncertainty."""
SAME_CURRENT = 0.01
"""Currents that differ by at most this share are the same."""
OF_THE_CURVE = ("threshold_us", "plateau_nm")
"""Figures that depend on the current: not compared across two currents."""
FLOORS = {
    "threshold_us": ((0.0, 2.5), (0.0, 10.0)),
    "plateau_nm": ((0.02, 0.0), (0.15, 0.0)),
    "time_constant_s": ((0.02, 0.0), (0.2, 0.0)),
    "damping": ((0.025, 0.0), (0.35, 0.0)),
    "delay_s": ((0.0, 0.001), (0.0, 0.005)),
}
"""The least uncertainty of a difference, a share of the value and an amount in the unit of the figure: in the same
structure, and where method or effects differ (fatigue in a model raises its plateau)."""
OF_EFFECT = ((0.1, 0.0), (0.3, 0.0))
"""The same for a parameter of an effect."""
CONDITIONS = {"electrodes": "electrodes", "side": "the side", "posture": "posture"}
"""Kinds of notes that put a comparison in doubt where they differ."""


@dataclass(frozen=True)
class State:
    """A model's figures and the conditions under which they were estimated."""

    figures: dict[str, Figure]
    method: str
    structure: tuple[str, ...]
    """Its effects, each `id:form`."""
    current_ma: float | None = None
    notes: dict[str, str] = field(default_factory=dict)
    """Notes on each of the conditions."""


def structure_of(effects: Collection[str], figures: dict[str, Figure]) -> tuple[str, ...]:
    """Each effect as `id:form`, `id` where its form is not known: a parameter means something else in another form."""
    forms = {name.partition(".")[0]: figure["form"] for name, figure in figures.items() if figure.get("form")}
    return tuple(sorted(f"{effect}:{forms.get(effect, '')}".removesuffix(":") for effect in effects))


# ---- in figures ---------------------------------------------------------------------------------------------------


def uncertainty(name: str, figure: Figure) -> float | None:
    """Return the uncertainty of a figure in its unit; those of two figures add up to that of their difference."""
    if figure.get("value") is None or figure.get("sd") is None:
        return None
    return math.hypot(figure["sd"], _floor(name, True, figure["value"]) / math.sqrt(2))


def _floor(name: str, same: bool, value: float) -> float:
    share, amount = (OF_EFFECT if "." in name else FLOORS[name])[0 if same else 1]
    return max(share * abs(value), amount)


def comparable(before: State, now: State) -> list[str]:
    """List the figures that both models have with the same meaning."""
    return [
        name for name, figure in now.figures.items()
        if name in before.figures and before.figures[name].get("form") == figure.get("form")
        and (name not in OF_THE_CURVE or same_current(before, now))
        and fact_of(name.partition(".")[0], "muscle", True)
    ]  # fmt: skip


def same_current(before: State, now: State) -> bool:
    """Return whether the currents are equal, as far as they are known."""
    if before.current_ma is None or now.current_ma is None:
        return True
    return abs(before.current_ma - now.current_ma) <= SAME_CURRENT * max(before.current_ma, now.current_ma)


def changed(before: State, now: State) -> list[dict[str, Any]]:
    """List the differences beyond twice their uncertainty, the most certain first.

    `before`, `now`, `difference` and `uncertainty` (one standard deviation of the difference) are in the `unit` of the
    `figure`; `percent` is of the value before; `times`: the difference over its uncertainty.
    """
    differences = []
    same = (before.method, before.structure) == (now.method, now.structure)
    for name in comparable(before, now):
        old, new = before.figures[name], now.figures[name]
        first, second = old.get("value"), new.get("value")
        if first is None or second is None or old.get("sd") is None or new.get("sd") is None:
            continue
        spread = math.hypot(old["sd"], new["sd"], max(_floor(name, same, first), _floor(name, same, second)))
        if abs(second - first) > BEYOND * spread > 0:
            change = {"before": first, "now": second, "difference": second - first, "uncertainty": spread}
            percent, times = 100 * (second - first) / abs(first) if first else None, abs(second - first) / spread
            unit = new.get("unit") or "1"
            differences.append({"figure": name, "unit": unit, **change, "percent": percent, "times": times})
    return sorted(differences, key=lambda item: -item["times"])


# ---- in words -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Name:
    """Display name and unit of a figure, and the factor from the stored unit to that unit.

    `digits` after the point; None: three significant ones. `in_percent`: whether a change of it is told in per cent.
    """

    words: str
    unit: str
    factor: float = 1.0
    digits: int | None = None
    in_percent: bool = False


NAMES = {
    "threshold_us": Name("Threshold", "µs", digits=1),
    "plateau_nm": Name("Plateau", "N·m", digits=2, in_percent=True),
    "time_constant_s": Name("Time constant", "s", digits=3, in_percent=True),
    "damping": Name("Damping", "", digits=3, in_percent=True),
    "delay_s": Name("Delay", "ms", 1e3, digits=1),
}
LAST_NAMES = {
    "held_out_fit_percent": Name("Fit, held out", "%", digits=1),
    "noise_sd_nm": Name("Noise of the torque sensor", "N·m", digits=3),
    "charge_uc": Name("Dose of the day", "mC", 1e-3, digits=2),
    "current_ma": Name("Current", "mA", digits=1),
}
"""Shown after the effects' parameters."""
UNBROKEN = "\u00a0"
"""Between a number and its unit no line ends."""


def in_order(figures: Iterable[str]) -> list[str]:
    """Return the figures that are shown, in the order in which they are shown."""
    return [*NAMES, *dict.fromkeys(name for name in figures if "." in name), *LAST_NAMES]


def name_of(figure: str, unit: str = "1") -> Name:
    """Return a figure's name; for an effect's parameter, the effect and the parameter without its unit."""
    if known := NAMES.get(figure) or LAST_NAMES.get(figure):
        return known
    effect, _dot, parameter = figure.partition(".")
    return Name(f"{effect_words(effect)}, {parameter_words(parameter)}", unit.removesuffix("1"), in_percent=True)


def value_words(value: float | None, name: Name, unit: bool = True) -> str:
    """Format a value in its display unit."""
    if value is None:
        return "–"
    scaled = value * name.factor
    digits = name.digits if name.digits is not None else _digits(scaled)
    text = f"{round(scaled, digits) + 0.0:.{digits}f}".replace("-", "−")  # + 0.0: no "−0"
    return f"{text}{UNBROKEN}{name.unit}" if unit and name.unit else text


def dose_words(charge_uc: float | None) -> str:
    """A dose on a page: the charge of one phase, summed over the pulses."""
    return value_words(charge_uc, LAST_NAMES["charge_uc"])


def uncertain_words(value: float | None, uncertainty: float | None, name: Name) -> str:
    """Format a value with twice its uncertainty, without the unit."""
    if uncertainty and name.digits is None:  # digits follow the uncertainty
        name = replace(name, digits=max(0, _digits(BEYOND * uncertainty * name.factor) - 1))
    words = value_words(value, name, unit=False)
    if value is None or uncertainty is None:
        return words
    return f"{words} ± {value_words(BEYOND * uncertainty, name, unit=False)}"


def _digits(value: float) -> int:
    return min(6, max(0, 2 - math.floor(math.log10(abs(value))))) if value else 0


def sentences(before: State, now: State, since_utc: str) -> list[str]:
    """Describe each change beyond its uncertainty in a sentence; without changes, one sentence says that."""
    day = local_time.day(since_utc)
    moved = [_sentence(each, day) for each in changed(before, now)]
    return moved or [f"Nothing changed beyond its uncertainty since {day}."]


def _sentence(change: dict[str, Any], day: str) -> str:
    """Describe a change and its certainty. For a falling curve the plateau's magnitude is compared."""
    name, first, second = name_of(change["figure"], change["unit"]), change["before"], change["now"]
    if first * second < 0:
        return f"{name.words}: {value_words(second, name)}, it was {value_words(first, name)} on {day}."
    amount = value_words(abs(change["difference"]), name)
    if name.in_percent and change["percent"] is not None:
        percent = abs(change["percent"])
        amount = f"{percent:.{1 if percent < 9.95 else 0}f}{UNBROKEN}%"
    which = "lower" if abs(second) < abs(first) else "higher"
    return f"{name.words} {amount} {which} than on {day}, more than twice its uncertainty."


def doubt_sentences(before: State, now: State) -> list[str]:
    """Describe what limits the comparison, a sentence each: current, method, effects or notes that differ."""
    reasons = []
    if before.current_ma is None or now.current_ma is None:
        reasons.append(
            "The current of a recording is not known: threshold and plateau compare only at the same current."
        )
    elif not same_current(before, now):
        was, now_is = (value_words(state.current_ma, LAST_NAMES["current_ma"]) for state in (before, now))
        reasons.append(f"The current was {was}, now it is {now_is}: threshold and plateau are not compared.")
    large = "only large differences are told"
    if before.method != now.method:
        reasons.append(f"The methods differ ({before.method}, then {now.method}): {large}.")
    if before.structure != now.structure:
        old, new = (effects_words(state.structure) or "none" for state in (before, now))
        differ = f"The models' effects differ ({old}, then {new})"
        ways = f"The models describe {new} in different ways"
        reasons.append(f"{ways if old == new else differ}: {large}.")
    for kind, words in CONDITIONS.items():
        first, second = before.notes.get(kind, ""), now.notes.get(kind, "")
        if first.split() != second.split():
            reasons.append(f"The notes on {words} differ: “{first[:80] or '–'}”, then “{second[:80] or '–'}”.")
    return reasons
