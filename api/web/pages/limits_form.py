"""The form in which a person sets a participant's limits: what was typed, what is wrong with it, what it changes.

The range of joint angles is typed in degrees and kept in radians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from starlette.datastructures import FormData

from stimrig.api.services.participants import calibrated_utc
from stimrig.api.sessions import profiles
from stimrig.api.web.pages import typed
from stimrig.rig.messages import Bound, Status

LONGEST_SHOWN = 60
ANGLES = ("angle_from_deg", "angle_to_deg")
ANGLE_LABELS = {"angle_from_deg": "Joint angle from (°)", "angle_to_deg": "Joint angle to (°)"}
HALF_A_STEP_DEG = 0.006
"""What is shown has two digits behind the point: nearer than half of them is the same angle."""


@dataclass
class LimitsForm:
    """The form, as it is shown or was sent."""

    texts: dict[str, str]  # what stands in each field
    seen: dict[str, str]  # what stood in each field when it was made
    asked: dict[str, Any] = field(default_factory=dict)  # the limits that change, as numbers
    errors: dict[str, str] = field(default_factory=dict)  # what is wrong, one line a field
    notice: str = ""  # what is to be said above it


def fresh(profile: Mapping[str, Any], status: Status | None) -> LimitsForm:
    """The form with what is saved."""
    texts = {name: typed.number_text(profile[name]) if name in profile else "" for name in profiles.LIMITS}
    texts |= angle_texts(profile, status)
    return LimitsForm(texts, dict(texts))


def read(sent: FormData, profile: Mapping[str, Any], status: Status | None) -> LimitsForm:
    """The form as a person sent it, held against what is saved.

    A field that still holds what it was made with asks for nothing, so a limit that somebody else has set meanwhile is
    not set back by a form that only wanted another one.
    """
    form = fresh(profile, status)
    form.seen |= {name: text for name in form.seen if (text := _one(sent, f"seen_{name}")) is not None}
    for name in profiles.LIMITS:
        _take(form, name, sent, profile.get(name))
    limits: Mapping[str, Bound] = status.limits if status else {}
    for name, words in profiles.outside(form.asked, profile, limits).items():
        form.errors[name] = f"{form.texts[name]!r}: {words}"
    _take_angles(form, sent, profile, status)
    if form.errors:
        form.notice = "Nothing was changed, nothing was started: see beside the field."
    return form


def _take_angles(form: LimitsForm, sent: FormData, profile: Mapping[str, Any], status: Status | None) -> None:
    """The range of angles, where the form has its fields."""
    given = {name: text[:LONGEST_SHOWN] for name in ANGLES if (text := _one(sent, name)) is not None}
    if len(given) < len(ANGLES) or given.items() <= form.seen.items():
        return
    asked, errors = asked_angles(given, profile, status)
    rigs = (status.angle.range_rad if status else None) or (profiles.LEAST_RAD, profiles.MOST_RAD)
    if beyond := profiles.range_outside(asked, rigs):
        errors[ANGLES[1]] = beyond[profiles.RANGE]
    form.texts |= given
    form.errors |= errors
    form.asked |= {} if errors else asked


def _take(form: LimitsForm, name: str, sent: FormData, saved: float | None) -> None:
    given = set(sent.getlist(name))
    if not given or given == {form.seen[name]}:
        return
    form.texts[name] = str(given.pop())[:LONGEST_SHOWN]
    if given:
        form.errors[name] = "it was sent twice, with two values; type one"
        return
    try:
        value = typed.number(form.texts[name])
    except ValueError as error:
        form.errors[name] = str(error)
        return
    if value != saved:
        form.asked[name] = value


def _one(sent: FormData, name: str) -> str | None:
    value = sent.get(name)
    return value if isinstance(value, str) else None


def fields(status: Status | None) -> list[dict[str, str]]:
    """What the fields are called, and what this rig takes in them."""
    limits: Mapping[str, Bound] = status.limits if status else {}
    return [
        {"name": name, "label": limit.label, "help": profiles.takes(name, limits)}
        for name, limit in profiles.LIMITS.items()
    ] + angle_fields(status)


def angle_texts(profile: Mapping[str, Any], status: Status | None) -> dict[str, str]:
    """What stands in the two fields; empty where there is no range, or the sensor was calibrated anew since."""
    range_rad = profiles.range_of(profile)
    if range_rad is None or (has_sensor(status) and profiles.range_outdated(profile, calibrated_utc(status))):
        return dict.fromkeys(ANGLES, "")
    return {name: angle_text(angle) for name, angle in zip(ANGLES, range_rad, strict=True)}


def angle_text(angle_rad: float) -> str:
    """An angle as a person would type it."""
    return typed.number_text(round(math.degrees(angle_rad), 2) + 0.0)


def has_sensor(status: Status | None) -> bool:
    """Whether the rig has an angle sensor: without one there are no such fields."""
    return status is not None and status.angle.present


def angle_fields(status: Status | None) -> list[dict[str, str]]:
    """What the fields are called, and what this rig takes in them."""
    if status is None or not status.angle.present:
        return []
    within = "" if status.angle.range_rad is None else f"within {profiles.range_words(status.angle.range_rad)} (rig)"
    help_of = {ANGLES[0]: "0° is the straight limb", ANGLES[1]: within}
    return [{"name": name, "label": ANGLE_LABELS[name], "help": help_of[name]} for name in ANGLES]


def read_pose(text: str, status: Status | None) -> float:
    """The angle that a goniometer shows, rad, from its text in degrees.

    Raises ValueError: no plain number, or no angle that this rig takes; one line for people.
    """
    angle_rad = math.radians(typed.signed(text))
    rigs = status.angle.range_rad if status else None
    if rigs is not None and not (rigs[0] <= angle_rad <= rigs[1]):
        raise ValueError(f"{angle_text(angle_rad) + '°'} is not within {profiles.range_words(rigs)}, as this rig asks")
    return angle_rad


def asked_angles(
    given: Mapping[str, str], profile: Mapping[str, Any], status: Status | None
) -> tuple[dict[str, Any], dict[str, str]]:
    """The range that is asked for as part of a profile, and what is wrong with it, by field.

    Nothing is asked where the fields say what is saved. Both empty: the participant has no range any more.
    """
    before = angle_texts(profile, status)
    if dict(given) == before:
        return {}, {}
    if not any(text.strip() for text in given.values()):
        return ({} if profiles.range_of(profile) is None else {profiles.RANGE: None}), {}
    values, errors = typed.numbers(given, typed.signed)
    if errors:
        return {}, errors
    low, high = (math.radians(values[name]) for name in ANGLES)
    if not (high - low >= profiles.NARROWEST_RAD - 1e-9):
        least = math.degrees(profiles.NARROWEST_RAD)
        return {}, {ANGLES[1]: f"the second angle must be at least {least:.0f}° above the first"}
    saved = profiles.range_of(profile) if before[ANGLES[0]] else None
    near = math.radians(HALF_A_STEP_DEG)
    if saved is not None and abs(saved[0] - low) < near and abs(saved[1] - high) < near:
        return {}, {}
    return {profiles.RANGE: [low, high]}, {}
