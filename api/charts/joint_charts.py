"""Figures of g and h of a moving joint over its angle: a curve for each way to move, its band where it was seen.

MODEL.json has both as tables over angle and velocity, with how often each cell was seen (`joint`). A curve is one
column of such a table, as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from stimrig.api.charts import figure as fig
from stimrig.api.charts.figure import Axis, Band, Curve, Figure, Value

STILL_RAD_S, FAST_RAD_S = 0.15, 0.7
"""The ways to move, as the coverage of the guided tests divides them (`api.sessions.joint_plan`)."""
NEAR_RAD = math.radians(3) + 1e-9
"""An angle counts as seen if the joint was this near to it: the table is finer than any movement."""
MARK_EVERY = 6


@dataclass(frozen=True)
class Way:
    """A way to move: velocities from `low` to below `high`, rad/s, and how its curve looks."""

    name: str
    low: float
    high: float
    colour: str
    width: float
    marker: str


WAYS = (
    Way("still", -STILL_RAD_S, STILL_RAD_S, "series-6", 1.8, "circle"),
    Way("flexion", STILL_RAD_S, FAST_RAD_S, "series-1", 1.4, "up"),
    Way("flexion", FAST_RAD_S, math.inf, "series-3", 2.6, "up"),
    Way("extension", -FAST_RAD_S, -STILL_RAD_S, "series-2", 1.4, "down"),
    Way("extension", -math.inf, -FAST_RAD_S, "series-4", 2.6, "down"),
)
"""Told apart by more than their colours: up is bending, and the thick line is the quick one."""


def joint_figures(document: dict[str, Any]) -> dict[str, Figure]:
    """Return both figures of a model with a moving joint; none of another one, nor where the coverage is not known."""
    joint = document.get("joint") or {}
    if not (joint.get("seen_h") and joint.get("seen_g")):
        return {}
    return {
        "joint_g": _figure(joint, "g", "", fig.FACTOR, "Share of the torque (1)"),
        "joint_h": _figure(joint, "h", "_nm", fig.TORQUE, "Passive torque (N·m)"),
    }


def columns(joint: dict[str, Any], table: str) -> list[tuple[Way, int, list[bool]]]:
    """Return the columns that are drawn of `g` or `h`, and at which angles the joint was seen to move so.

    For each way to move the velocity that was seen most: both tables show the same velocities. A way that was seen at
    no angle is left out.
    """
    velocity, angle_rad = joint["velocity_rad_s"], joint["angle_rad"]
    counts = [sum(row[k] for name in ("seen_g", "seen_h") for row in joint[name]) for k in range(len(velocity))]
    selected = []
    for way in WAYS:
        inside = [k for k, value in enumerate(velocity) if way.low <= value < way.high]
        angles = [
            angle for angle, row in zip(angle_rad, joint[f"seen_{table}"], strict=True) if sum(row[k] for k in inside)
        ]
        if not angles:
            continue
        still = way.name == "still"
        column = min(inside, key=lambda k: abs(velocity[k])) if still else max(inside, key=counts.__getitem__)
        selected.append((way, column, [any(abs(angle - other) <= NEAR_RAD for other in angles) for angle in angle_rad]))
    return selected


def _figure(joint: dict[str, Any], name: str, unit: str, value: Value, title: str) -> Figure:
    angle_deg = [round(math.degrees(angle), 3) for angle in joint["angle_rad"]]
    bands: list[Band] = []
    dotted: list[Curve] = []
    lines: list[Curve] = []
    for way, column, is_covered in columns(joint, name):
        y = [row[column] for row in joint[name + unit]]
        notes: list[str] = []
        if f"{name}_lower{unit}" in joint:
            lower, upper = ([row[column] for row in joint[f"{name}_{edge}{unit}"]] for edge in ("lower", "upper"))
            whole = Band(angle_deg, lower, upper, colour="series-band", listed=not bands)
            bands += _seen_parts(whole, is_covered)
            notes = fig.half_widths(whole, angle_deg)
        if not all(is_covered):
            label = "" if dotted else "dotted: not seen"
            dotted.append(Curve(angle_deg, y, label, way.colour, 1.2, "dot", listed=not dotted))
        solid = [value if was_seen else None for value, was_seen in zip(y, is_covered, strict=True)]
        lines.append(Curve(angle_deg, solid, _label(way, joint["velocity_rad_s"][column]), way.colour, way.width,
                           marker=way.marker, size=7, every=MARK_EVERY, value=value, notes=notes))  # fmt: skip
    x = Axis("Joint angle (°)", fig.AT_ANGLE, (angle_deg[0], angle_deg[-1]))
    return Figure(x, (Axis(title),), (*dotted, *lines), tuple(bands), height=430)


def _seen_parts(band: Band, is_covered: Sequence[bool]) -> list[Band]:
    """Return the band of each stretch of two angles or more that was seen; the legend names the first of all."""
    edges = [row for row, (before, now) in enumerate(pairwise([False, *is_covered, False])) if before != now]
    parts = []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin >= 2:
            part = slice(begin, end)
            parts.append(Band(band.x[part], band.lower[part], band.upper[part], colour=band.colour,
                              listed=band.listed and not parts))  # fmt: skip
    return parts


def _label(way: Way, velocity_rad_s: float) -> str:
    speed = f"{abs(math.degrees(velocity_rad_s)):.0f}"
    if way.name == "still":
        return "not moving"
    return f"bending {speed}°/s" if way.name == "flexion" else f"straightening {speed}°/s"
