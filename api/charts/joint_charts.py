"""g and h of a joint that moves, over the angle: a curve for each way to move, its band where the joint was seen there.

MODEL.json has both as tables over angle and velocity, with how often each cell was seen (`joint`). A curve is one
column of such a table, as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.api.charts import hover
from stimrig.api.charts.model_charts import axis, filled, layout, line
from stimrig.api.charts.palette import role
from stimrig.api.language import _

STILL_RAD_S, FAST_RAD_S = 0.15, 0.7
"""The ways to move, as the coverage of the guided tests divides them (`stimrig.api.sessions.coverage`)."""
NEAR_RAD = math.radians(3) + 1e-9
"""An angle counts as seen if the joint was this near to it: the table is finer than any movement."""
BAND = role("series-band")
HEIGHT_PX = 430


@dataclass(frozen=True)
class Way:
    """A way to move: velocities from `low` to below `high`, rad/s, and how its curve looks."""

    name: str
    low: float
    high: float
    colour: str
    width: float

    def has(self, velocity_rad_s: float) -> bool:
        """Whether a velocity is one of it."""
        return self.low <= velocity_rad_s < self.high


WAYS = (
    Way("still", -STILL_RAD_S, STILL_RAD_S, role("series-6"), 1.8),
    Way("flexion", STILL_RAD_S, FAST_RAD_S, role("series-1"), 1.4),
    Way("flexion", FAST_RAD_S, math.inf, role("series-3"), 2.6),
    Way("extension", -FAST_RAD_S, -STILL_RAD_S, role("series-2"), 1.4),
    Way("extension", -math.inf, -FAST_RAD_S, role("series-4"), 2.6),
)


@dataclass(frozen=True)
class Curve:
    """One column of a table.

    Parameters
    ----------
    way : Way
        What it is a column of.
    column : int
        Its number.
    seen : list of bool, one for each angle
        Whether the joint was near the angle while it moved this way.
    """

    way: Way
    column: int
    seen: list[bool]

    def kept(self, table: Sequence[Sequence[float]]) -> list[float]:
        """The column of a table."""
        return [row[self.column] for row in table]

    def runs(self) -> list[tuple[int, int]]:
        """First and last row of each stretch that was seen, of two rows at least."""
        edges = [row for row in range(len(self.seen) + 1)
                 if (row < len(self.seen) and self.seen[row]) != (row > 0 and self.seen[row - 1])]  # fmt: skip
        return [(first, end - 1) for first, end in zip(edges[::2], edges[1::2], strict=True) if end - first > 1]


def of_joint(document: dict[str, Any]) -> dict[str, Any]:
    """Both figures of a model with a moving joint; none of another one, nor where it is not known what was seen."""
    joint = document.get("joint") or {}
    if not (joint.get("seen_h") and joint.get("seen_g")):
        return {}
    return {
        "joint_g": _figure(joint, "g", "", hover.FACTOR, _("Share of the torque (1)")),
        "joint_h": _figure(joint, "h", "_nm", hover.TORQUE, _("Passive torque (N·m)")),
    }


def curves(joint: dict[str, Any], table: str) -> list[Curve]:
    """The columns that are drawn of `g` or `h`: for each way to move the velocity that was seen most.

    Both tables show the same velocities. A way that was seen at no angle is left out.
    """
    velocity = joint["velocity_rad_s"]
    often = [sum(row[k] for name in ("seen_g", "seen_h") for row in joint[name]) for k in range(len(velocity))]
    found = []
    for way in WAYS:
        inside = [k for k, value in enumerate(velocity) if way.has(value)]
        if not inside:
            continue
        column = (
            min(inside, key=lambda k: abs(velocity[k])) if way.name == "still" else max(inside, key=often.__getitem__)
        )
        seen = _near(joint["angle_rad"], [sum(row[k] for k in inside) for row in joint[f"seen_{table}"]])
        if any(seen):
            found.append(Curve(way, column, seen))
    return found


def _near(angle_rad: Sequence[float], times: Sequence[int]) -> list[bool]:
    there = [angle for angle, count in zip(angle_rad, times, strict=True) if count > 0]
    return [any(abs(angle - other) <= NEAR_RAD for other in there) for angle in angle_rad]


def _figure(joint: dict[str, Any], name: str, unit: str, value: str, title: str) -> dict[str, Any]:
    angle_deg = [round(math.degrees(angle), 3) for angle in joint["angle_rad"]]
    shown = curves(joint, name)
    bands: list[dict[str, Any]] = []
    dotted: list[dict[str, Any]] = []
    lines: list[dict[str, Any]] = []
    for curve in shown:
        y = curve.kept(joint[name + unit])
        halves: list[float] = []
        if f"{name}_lower{unit}" in joint:
            lower, upper = (curve.kept(joint[f"{name}_{edge}{unit}"]) for edge in ("lower", "upper"))
            bands += _banded(angle_deg, curve, lower, upper, first=not bands)
            halves = [(high - low) / 2 for low, high in zip(lower, upper, strict=True)]
        if not all(curve.seen):
            dotted.append(line(angle_deg, y, "", curve.way.colour, 1.2, line={"dash": "dot"}, showlegend=False,
                               **hover.QUIET))  # fmt: skip
        words = _words(curve.way, joint["velocity_rad_s"][curve.column])
        lines.append(line(angle_deg, [at if seen else None for at, seen in zip(y, curve.seen, strict=True)], words,
                          curve.way.colour, curve.way.width, **hover.with_halves(words, value, halves)))  # fmt: skip
    if dotted:  # an entry of the legend, without a line
        told = line(
            angle_deg[:1], [None], _("dotted: not seen"), role("mark"), 1.2, line={"dash": "dot"}, **hover.QUIET
        )
        lines.append(told)
    x = axis(_("Joint angle (°)"), range=[angle_deg[0], angle_deg[-1]], **hover.AT_ANGLE)
    return {"data": [*bands, *dotted, *lines], "layout": layout(height=HEIGHT_PX, xaxis=x, yaxis=axis(title))}


def _banded(
    angle_deg: Sequence[float], curve: Curve, lower: Sequence[float], upper: Sequence[float], first: bool
) -> list[dict[str, Any]]:
    """The band of each stretch that was seen; the first of all is the legend's."""
    data: list[dict[str, Any]] = []
    for begin, last in curve.runs():
        part = slice(begin, last + 1)
        pair = filled(angle_deg[part], lower[part], upper[part], _("95 %% band"), BAND)
        if data or not first:
            pair[1] |= {"name": "", "showlegend": False}
        data += pair
    return data


def _words(way: Way, velocity_rad_s: float) -> str:
    speed = f"{abs(math.degrees(velocity_rad_s)):.0f}"
    if way.name == "still":
        return _("not moving")
    return (
        _("bending %(speed)s°/s", speed=speed)
        if way.name == "flexion"
        else _("straightening %(speed)s°/s", speed=speed)
    )
