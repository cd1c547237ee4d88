"""MODEL.json's `joint` of a made-up arm: surfaces that are easy to compute, seen in some places and not in others."""

from __future__ import annotations

import math
from typing import Any

REFERENCE_RAD = math.radians(80)
ANGLES_RAD = [math.radians(20 + 1.5 * k) for k in range(61)]
VELOCITIES_RAD_S = [1.6 * share for share in (-1, -0.75, -0.5, -0.25, -0.12, -0.02, 0, 0.02, 0.12, 0.25, 0.5, 0.75, 1)]


def g(angle_rad: float, velocity_rad_s: float) -> float:
    """Share of the torque at the reference angle."""
    return 1.0 - 0.4 * (angle_rad - REFERENCE_RAD) ** 2 - 0.1 * velocity_rad_s


def h_nm(angle_rad: float, velocity_rad_s: float) -> float:
    """Passive torque, N·m."""
    return -0.8 * (angle_rad - REFERENCE_RAD) - 0.2 * velocity_rad_s


def half(angle_rad: float) -> float:
    """Half of each band: widest at the ends of the range."""
    return 0.02 + 0.05 * abs(angle_rad - REFERENCE_RAD)


def seen_h(angle_rad: float, velocity_rad_s: float) -> int:
    """Fast not at the ends of the range, slow everywhere; at 0.4 and 0.8 rad/s most."""
    inside = math.radians(30) <= angle_rad <= math.radians(100)
    often = 9 if round(abs(velocity_rad_s), 3) in (0.4, 0.8) else 3
    return often if abs(velocity_rad_s) < 0.7 or inside else 0


def seen_g(angle_rad: float, velocity_rad_s: float) -> int:
    """Not moving at 40° and 70° only; slowly below 90°; fast bending below 60°, fast straightening never."""
    degrees = math.degrees(angle_rad)
    if abs(velocity_rad_s) < 0.15:
        return int(min(abs(degrees - 40), abs(degrees - 70)) < 1)
    return int(degrees < 90) if abs(velocity_rad_s) < 0.7 else int(velocity_rad_s > 0 and degrees < 60)


def joint() -> dict[str, Any]:
    """All of it."""

    def table(law: Any) -> list[list[Any]]:
        return [[law(x, v) for v in VELOCITIES_RAD_S] for x in ANGLES_RAD]

    return {
        "reference_angle_rad": REFERENCE_RAD, "angle_rad": ANGLES_RAD, "velocity_rad_s": VELOCITIES_RAD_S,
        "g": table(g), "g_lower": table(lambda x, v: g(x, v) - half(x)),
        "g_upper": table(lambda x, v: g(x, v) + half(x)),
        "h_nm": table(h_nm), "h_lower_nm": table(lambda x, v: h_nm(x, v) - half(x)),
        "h_upper_nm": table(lambda x, v: h_nm(x, v) + half(x)),
        "seen_g": table(seen_g), "seen_h": table(seen_h), "inertia_nm_s2_per_rad": 0.05, "level_percent": 95,
        "formula": {"torque": "T = g y + h", "g": ["made up"], "h": ["made up"]},
    }  # fmt: skip
