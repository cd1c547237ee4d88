"""Figures of g and h of a moving joint over its angle: a curve for each way to move, its band where it was seen.

MODEL.json has both as tables over angle and velocity, with how often each cell was seen (`joint`). A curve is one
column of such a table, as it stands.
"""

from __future__ import annotations

import math
from itertools import groupby
from typing import Any

from stimrig.api.charts.figure import Axis, Band, Figure, Line

STILL_RAD_S, FAST_RAD_S = 0.15, 0.7
"""The ways to move, as the coverage of the guided tests divides them (`api.sessions.joint_plan`)."""
NEAR_RAD = math.radians(3) + 1e-9
"""An angle counts as seen if the joint was this near to it: the table is finer than any movement."""
WAYS = (
    ("not moving", -STILL_RAD_S, STILL_RAD_S, "series-6", 1.8, "o"),
    ("bending", STILL_RAD_S, FAST_RAD_S, "series-1", 1.4, "^"),
    ("bending", FAST_RAD_S, math.inf, "series-3", 2.6, "^"),
    ("straightening", -FAST_RAD_S, -STILL_RAD_S, "series-2", 1.4, "v"),
    ("straightening", -math.inf, -FAST_RAD_S, "series-4", 2.6, "v"),
)
"""Name, velocities from and to (rad/s), colour, width and marker of each: told apart by more than their colours."""


def joint_figures(document: dict[str, Any]) -> dict[str, Figure]:
    """Return both figures of a model with a moving joint; none of another one, nor where the coverage is not known."""
    joint = document.get("joint") or {}
    if not (joint.get("seen_h") and joint.get("seen_g")):
        return {}
    return {
        "joint_g": _figure(joint, "g", "", "Share of the torque (1)"),
        "joint_h": _figure(joint, "h", "_nm", "Passive torque (N·m)"),
    }


def _figure(joint: dict[str, Any], name: str, unit: str, title: str) -> Figure:
    """Draw of each way to move the velocity that was seen most; a way that was seen at no angle is left out."""
    velocity, angle_rad = joint["velocity_rad_s"], joint["angle_rad"]
    angle_deg = [round(math.degrees(angle), 3) for angle in angle_rad]
    counts = [sum(row[k] for table in ("seen_g", "seen_h") for row in joint[table]) for k in range(len(velocity))]
    bands: list[Band] = []
    dotted: list[Line] = []
    lines: list[Line] = []
    for way, low, high, colour, width, marker in WAYS:
        inside = [k for k, value in enumerate(velocity) if low <= value < high]
        rows = zip(angle_rad, joint[f"seen_{name}"], strict=True)
        covered_rad = [angle for angle, row in rows if any(row[k] for k in inside)]
        if not covered_rad:
            continue
        still = way == "not moving"
        column = min(inside, key=lambda k: abs(velocity[k])) if still else max(inside, key=counts.__getitem__)
        near = [any(abs(angle - other) <= NEAR_RAD for other in covered_rad) for angle in angle_rad]
        y = [row[column] for row in joint[name + unit]]
        if f"{name}_lower{unit}" in joint:
            lower, upper = ([row[column] for row in joint[f"{name}_{edge}{unit}"]] for edge in ("lower", "upper"))
            for is_near, stretch in groupby(range(len(near)), key=near.__getitem__):
                covered = list(stretch)
                part = slice(covered[0], covered[-1] + 1)
                if is_near and len(covered) > 1:
                    area = angle_deg[part], lower[part], upper[part]
                    bands.append(Band(*area, colour="series-band", listed=not bands))
        if not all(near):
            label = "" if dotted else "dotted: not seen"
            dotted.append(Line(angle_deg, y, label, colour, 1.2, dash="dot"))
        label = way if still else f"{way} {abs(math.degrees(velocity[column])):.0f}°/s"
        solid = [value if is_near else None for value, is_near in zip(y, near, strict=True)]
        lines.append(Line(angle_deg, solid, label, colour, width, marker=marker, size=7, most_markers=10))
    x = Axis("Joint angle (°)", (angle_deg[0], angle_deg[-1]))
    return Figure(x, [Axis(title)], [*bands, *dotted, *lines], 430)
