"""The range of joint angles in the form of a participant's limits: typed in degrees, kept in radians."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from api.sessions import angles
from api.web.pages import typed
from api.web.routes.participants import calibrated_utc
from rig.messages import Status

NAMES = ("angle_from_deg", "angle_to_deg")
LABELS = {"angle_from_deg": "Joint angle from (°)", "angle_to_deg": "Joint angle to (°)"}
HALF_A_STEP_DEG = 0.006
"""What is shown has two digits behind the point: nearer than half of them is the same angle."""


def texts(profile: Mapping[str, Any], status: Status | None) -> dict[str, str]:
    """What stands in the two fields; empty where there is no range, or the sensor was calibrated anew since."""
    range_rad = angles.of(profile)
    if range_rad is None or (present(status) and angles.outdated(profile, calibrated_utc(status))):
        return dict.fromkeys(NAMES, "")
    return {name: shown(angle) for name, angle in zip(NAMES, range_rad, strict=True)}


def shown(angle_rad: float) -> str:
    """An angle as a person would type it."""
    return typed.shown(round(math.degrees(angle_rad), 2) + 0.0)


def present(status: Status | None) -> bool:
    """Whether the rig has an angle sensor: without one there are no such fields."""
    return status is not None and status.angle.present


def fields(status: Status | None) -> list[dict[str, str]]:
    """What the fields are called, and what this rig takes in them."""
    if status is None or not status.angle.present:
        return []
    within = "" if status.angle.range_rad is None else f"within {angles.words(status.angle.range_rad)} (rig)"
    help_of = {NAMES[0]: "0° is a straight arm", NAMES[1]: within}
    return [{"name": name, "label": LABELS[name], "help": help_of[name]} for name in NAMES]


def of_pose(text: str, status: Status | None) -> float:
    """The angle that a goniometer shows, rad, from its text in degrees.

    Raises
    ------
    ValueError
        No plain number, or no angle that this rig takes; one line for people.
    """
    angle_rad = math.radians(typed.signed(text))
    rigs = status.angle.range_rad if status else None
    if rigs is not None and not (rigs[0] <= angle_rad <= rigs[1]):
        raise ValueError(f"{shown(angle_rad) + '°'} is not within {angles.words(rigs)}, as this rig asks")
    return angle_rad


def asked(
    given: Mapping[str, str], profile: Mapping[str, Any], status: Status | None
) -> tuple[dict[str, Any], dict[str, str]]:
    """The range that is asked for as part of a profile, and what is wrong with it, by field.

    Nothing is asked where the fields say what is saved. Both empty: the participant has no range any more.
    """
    before = texts(profile, status)
    if dict(given) == before:
        return {}, {}
    if not any(text.strip() for text in given.values()):
        return ({} if angles.of(profile) is None else {angles.RANGE: None}), {}
    values, errors = typed.numbers(given, typed.signed)
    if errors:
        return {}, errors
    low, high = (math.radians(values[name]) for name in NAMES)
    if not (high - low >= angles.NARROWEST_RAD - 1e-9):
        least = math.degrees(angles.NARROWEST_RAD)
        return {}, {NAMES[1]: f"the second angle must be at least {least:.0f}° above the first"}
    saved = angles.of(profile) if before[NAMES[0]] else None
    near = math.radians(HALF_A_STEP_DEG)
    if saved is not None and abs(saved[0] - low) < near and abs(saved[1] - high) < near:
        return {}, {}
    return {angles.RANGE: [low, high]}, {}
