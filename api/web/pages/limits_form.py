"""The fields in which a person types a participant's limits. Joint angles are typed in degrees and kept in radians."""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from stimrig.api.sessions import profiles
from stimrig.rig.messages import Status

ANGLE_LABELS = ("Joint angle from (°)", "Joint angle to (°)")


def number_text(value: float) -> str:
    """Write a number as it stands in a field: exactly, and as a person would type it."""
    text = format(Decimal(repr(float(value))), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def has_sensor(status: Status | None) -> bool:
    """Return whether the rig has an angle sensor."""
    return status is not None and status.angle.present


def fields(profile: Mapping[str, Any], status: Status | None) -> list[dict[str, str]]:
    """Return name, label, text and help of each field, with what this rig takes."""
    bounds = status.limits if status else {}
    entries = [
        {
            "name": name, "id": name, "label": limit.label, "type": "number", "empty": "",
            "text": number_text(profile[name]) if name in profile else "", "help": profiles.range_help(name, bounds),
        }
        for name, limit in profiles.LIMITS.items()
    ]  # fmt: skip
    if status is None or not status.angle.present:
        return entries
    range_rad, calibration = profiles.range_of(profile), status.angle.calibration
    outdated = profiles.range_outdated(profile, None if calibration is None else calibration.set_at_utc)
    shown_rad = (None, None) if range_rad is None or outdated else range_rad
    texts = ["" if rad is None else number_text(round(math.degrees(rad), 2) + 0.0) for rad in shown_rad]
    within = "" if status.angle.range_rad is None else f"within {profiles.range_words(status.angle.range_rad)} (rig)"
    return entries + [
        {
            "name": profiles.RANGE, "id": f"angle-{number}", "label": label, "type": "degrees list", "empty": "null",
            "text": text, "help": words,
        }
        for number, (label, text, words) in enumerate(
            zip(ANGLE_LABELS, texts, ("0° is the straight limb", within), strict=True)
        )
    ]  # fmt: skip
