"""What differs between two models of a muscle by more than its uncertainty, and what puts the comparison in doubt.

The standard deviations of both models say what the noise of the two records does. On emulated muscles that had not
changed they are right for most figures and too small for some (a curve's bend between two knots, an effect that no
model holds). So a floor is added to them: `python -m bench.trend`, docs/results/trend.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from stimrig.api.models.headline import Figure

BEYOND = 2.0
"""A change is told where it is more than so many times its uncertainty."""
SAME_CURRENT = 0.01
"""Currents that differ by at most this share are the same."""
OF_THE_CURVE = ("threshold_us", "plateau_nm")
"""What changes with the current alone: not compared across two currents."""
OF_THE_RECORD = ("baseline_drift", "mains_hum", "sensor_clipping", "tremor", "voluntary_effort")
"""Effects that are of one record, its sensor or its person's mood: their parameters change, and no muscle did."""


@dataclass(frozen=True)
class Floor:
    """The least uncertainty of a difference: a share of the value, or an amount in the figure's unit."""

    share: float = 0.0
    amount: float = 0.0

    def at(self, value: float) -> float:
        """In the figure's unit."""
        return max(self.share * abs(value), self.amount)


SAME_STRUCTURE = {
    "threshold_us": Floor(amount=2.5),
    "plateau_nm": Floor(share=0.02),
    "time_constant_s": Floor(share=0.02),
    "damping": Floor(share=0.025),
    "delay_s": Floor(amount=0.001),
}
OTHER_STRUCTURE = {
    "threshold_us": Floor(amount=10.0),
    "plateau_nm": Floor(share=0.15),
    "time_constant_s": Floor(share=0.2),
    "damping": Floor(share=0.35),
    "delay_s": Floor(amount=0.005),
}
"""Where method or effects differ, the same figure means something else: fatigue in a model raises its plateau."""
SAME_EFFECT, OTHER_EFFECT = Floor(share=0.1), Floor(share=0.3)
"""Of an effect's parameter."""


@dataclass(frozen=True)
class State:
    """What is compared: a model's figures, and under which conditions they were found."""

    figures: dict[str, Figure]
    method: str
    structure: tuple[str, ...]
    """Its effects, each `id:form`."""
    current_ma: float | None = None
    notes: tuple[tuple[str, str], ...] = ()
    """Kind and text of what was noted on the conditions."""

    def same_structure(self, other: State) -> bool:
        """Whether method and effects are the same."""
        return self.method == other.method and sorted(self.structure) == sorted(other.structure)


def difference(name: str, before: State, now: State) -> dict[str, Any] | None:
    """How far a figure moved, and how sure that is; None where it cannot be said.

    Returns
    -------
    dict
        `figure`, `unit`, `before`, `now`, `difference` and `uncertainty` (one standard deviation of the difference) in
        that unit; `percent` of the value before; `times`, the difference over its uncertainty; `beyond`.
    """
    old, new = before.figures.get(name) or {}, now.figures.get(name) or {}
    first, second = old.get("value"), new.get("value")
    if first is None or second is None:
        return None
    found = {"figure": name, "unit": new.get("unit") or "1", "before": first, "now": second}
    found |= {"difference": second - first, "percent": 100 * (second - first) / abs(first) if first else None}
    if old.get("sd") is None or new.get("sd") is None:
        return found | {"uncertainty": None, "times": None, "beyond": False}
    floor = _floor(name, before.same_structure(now)).at(first)
    uncertainty = math.hypot(old["sd"], new["sd"], floor)
    times = abs(second - first) / uncertainty if uncertainty > 0 else 0.0
    return found | {"uncertainty": uncertainty, "times": times, "beyond": times > BEYOND}


def uncertainty(name: str, figure: Figure) -> float | None:
    """A figure's own uncertainty, in its unit, such that of two they add up to that of their difference."""
    if figure.get("value") is None or figure.get("sd") is None:
        return None
    floor = _floor(name, True).at(figure["value"])
    return math.hypot(figure["sd"], floor / math.sqrt(2))


def _floor(name: str, same: bool) -> Floor:
    if "." in name:
        return SAME_EFFECT if same else OTHER_EFFECT
    return (SAME_STRUCTURE if same else OTHER_STRUCTURE)[name]


def comparable(before: State, now: State) -> list[str]:
    """The figures that both have and that mean the same in both."""
    forms = {name: (before.figures[name].get("form"), figure.get("form")) for name, figure in now.figures.items()
             if name in before.figures}  # fmt: skip
    names = [name for name, (old, new) in forms.items() if old == new]
    if not same_current(before, now):
        names = [name for name in names if name not in OF_THE_CURVE]
    return [name for name in names if name.partition(".")[0] not in OF_THE_RECORD]


def same_current(before: State, now: State) -> bool:
    """Whether the current was the same, as far as it is known."""
    if before.current_ma is None or now.current_ma is None:
        return True
    return abs(before.current_ma - now.current_ma) <= SAME_CURRENT * max(before.current_ma, now.current_ma)


def changed(before: State, now: State) -> list[dict[str, Any]]:
    """The differences beyond twice their uncertainty, the surest first."""
    found = [difference(name, before, now) for name in comparable(before, now)]
    return sorted((one for one in found if one and one["beyond"]), key=lambda one: -one["times"])


def doubts(before: State, now: State) -> list[dict[str, Any]]:
    """What differs in the conditions, each `kind` with `before` and `now`."""
    found: list[dict[str, Any]] = []
    if not same_current(before, now):
        found.append({"kind": "current", "before": before.current_ma, "now": now.current_ma})
    elif before.current_ma is None or now.current_ma is None:
        found.append({"kind": "current unknown", "before": before.current_ma, "now": now.current_ma})
    if before.method != now.method:
        found.append({"kind": "method", "before": before.method, "now": now.method})
    if sorted(before.structure) != sorted(now.structure):
        found.append({"kind": "effects", "before": list(before.structure), "now": list(now.structure)})
    old, new = dict(before.notes), dict(now.notes)
    noted = [(kind, old.get(kind, ""), new.get(kind, "")) for kind in sorted(old.keys() | new.keys())]
    return found + [
        {"kind": kind, "before": first, "now": second}
        for kind, first, second in noted
        if first.split() != second.split()
    ]
