"""g and h of a joint that moves, over the angle: a curve for each way to move, its band where the joint was seen there.

MODEL.json has both as tables over angle and velocity, with how often each cell was seen (`joint`). A curve is one
column of such a table, as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import axis, filled, line, role

STILL_RAD_S, FAST_RAD_S = 0.15, 0.7
"""The ways to move, as the coverage of the guided tests divides them (`api.sessions.joint_plan`)."""
NEAR_RAD = math.radians(3) + 1e-9
"""An angle counts as seen if the joint was this near to it: the table is finer than any movement."""


@dataclass(frozen=True)
class Way:
    """A way to move: velocities from `low` to below `high`, rad/s, and how its curve looks."""

    name: str
    low: float
    high: float
    colour: str
    width: float
    symbol: str


WAYS = (
    Way("still", -STILL_RAD_S, STILL_RAD_S, role("series-6"), 1.8, "circle"),
    Way("flexion", STILL_RAD_S, FAST_RAD_S, role("series-1"), 1.4, "triangle-up"),
    Way("flexion", FAST_RAD_S, math.inf, role("series-3"), 2.6, "triangle-up"),
    Way("extension", -FAST_RAD_S, -STILL_RAD_S, role("series-2"), 1.4, "triangle-down"),
    Way("extension", -math.inf, -FAST_RAD_S, role("series-4"), 2.6, "triangle-down"),
)
"""Told apart by more than their colours: up is bending, and the thick line is the quick one."""
EVERY = 6
"""So many angles from one marker of a line to the next."""


def joint_figures(document: dict[str, Any]) -> dict[str, Any]:
    """Both figures of a model with a moving joint; none of another one, nor where it is not known what was seen."""
    joint = document.get("joint") or {}
    if not (joint.get("seen_h") and joint.get("seen_g")):
        return {}
    return {
        "joint_g": _figure(joint, "g", "", fig.FACTOR, "Share of the torque (1)"),
        "joint_h": _figure(joint, "h", "_nm", fig.TORQUE, "Passive torque (N·m)"),
    }


def columns(joint: dict[str, Any], table: str) -> list[tuple[Way, int, list[bool]]]:
    """The columns that are drawn of `g` or `h`, and at which angles the joint was seen to move so.

    For each way to move the velocity that was seen most: both tables show the same velocities. A way that was seen at
    no angle is left out.
    """
    velocity, angle_rad = joint["velocity_rad_s"], joint["angle_rad"]
    often = [sum(row[k] for name in ("seen_g", "seen_h") for row in joint[name]) for k in range(len(velocity))]
    found = []
    for way in WAYS:
        inside = [k for k, value in enumerate(velocity) if way.low <= value < way.high]
        there = [
            angle for angle, row in zip(angle_rad, joint[f"seen_{table}"], strict=True) if sum(row[k] for k in inside)
        ]
        if not there:
            continue
        still = way.name == "still"
        column = min(inside, key=lambda k: abs(velocity[k])) if still else max(inside, key=often.__getitem__)
        found.append((way, column, [any(abs(angle - other) <= NEAR_RAD for other in there) for angle in angle_rad]))
    return found


def _figure(joint: dict[str, Any], name: str, unit: str, value: str, title: str) -> dict[str, Any]:
    angle_deg = [round(math.degrees(angle), 3) for angle in joint["angle_rad"]]
    bands: list[dict[str, Any]] = []
    dotted: list[dict[str, Any]] = []
    lines: list[dict[str, Any]] = []
    for way, column, seen in columns(joint, name):
        y = [row[column] for row in joint[name + unit]]
        halves: list[float] = []
        if f"{name}_lower{unit}" in joint:
            lower, upper = ([row[column] for row in joint[f"{name}_{edge}{unit}"]] for edge in ("lower", "upper"))
            bands += _bands(angle_deg, seen, lower, upper, first=not bands)
            halves = fig.halves_of(lower, upper)
        if not all(seen):
            dots: dict[str, Any] = {"line": {"dash": "dot"}, "showlegend": False, **fig.QUIET}
            dotted.append(line(angle_deg, y, "", way.colour, 1.2, **dots))
        words = _words(way, joint["velocity_rad_s"][column])
        solid = [at if there else None for at, there in zip(y, seen, strict=True)]
        sizes = [0 if row % EVERY else 7 for row in range(len(angle_deg))]
        marked: dict[str, Any] = {"mode": "lines+markers", "marker": {"symbol": way.symbol, "size": sizes}}
        marked |= fig.hover_halves(words, value, halves)
        lines.append(line(angle_deg, solid, words, way.colour, way.width, **marked))
    if dotted:  # an entry of the legend, without a line
        dots = {"line": {"dash": "dot"}, **fig.QUIET}
        lines.append(line(angle_deg[:1], [None], "dotted: not seen", role("mark"), 1.2, **dots))
    x = axis("Joint angle (°)", range=[angle_deg[0], angle_deg[-1]], **fig.AT_ANGLE)
    return fig.figure([*bands, *dotted, *lines], height=430, xaxis=x, yaxis=axis(title))


def _bands(
    angle_deg: Sequence[float], seen: Sequence[bool], lower: Sequence[float], upper: Sequence[float], first: bool
) -> list[dict[str, Any]]:
    """The band of each stretch of two angles or more that was seen; the first of all is the legend's."""
    data: list[dict[str, Any]] = []
    edges = [row for row, (one, other) in enumerate(zip([*seen, False], [False, *seen], strict=True)) if one != other]
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin < 2:
            continue
        part = slice(begin, end)
        pair = filled(angle_deg[part], lower[part], upper[part], "95 % band", role("series-band"))
        if data or not first:
            pair[1] |= {"name": "", "showlegend": False}
        data += pair
    return data


def _words(way: Way, velocity_rad_s: float) -> str:
    speed = f"{abs(math.degrees(velocity_rad_s)):.0f}"
    if way.name == "still":
        return "not moving"
    return f"bending {speed}°/s" if way.name == "flexion" else f"straightening {speed}°/s"
