"""The form in which a person sets a participant's limits: what was typed, what is wrong with it, what it changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from starlette.datastructures import FormData

from api.sessions import angles, profiles
from api.web.pages import angle_form, typed
from rig.messages import Bound, Status

LONGEST_SHOWN = 60


@dataclass
class LimitsForm:
    """The form, as it is shown or was sent.

    Parameters
    ----------
    texts : dict
        What stands in each field.
    seen : dict
        What stood in each field when it was made.
    asked : dict
        The limits that change, as numbers.
    errors : dict
        What is wrong, one line a field.
    notice : str
        What is to be said above it.
    """

    texts: dict[str, str]
    seen: dict[str, str]
    asked: dict[str, Any] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    notice: str = ""


def fresh(profile: Mapping[str, Any], status: Status | None) -> LimitsForm:
    """The form with what is saved."""
    texts = {name: typed.shown(profile[name]) for name in profiles.LIMITS} | angle_form.texts(profile, status)
    return LimitsForm(texts, dict(texts))


def read(sent: FormData, profile: Mapping[str, Any], status: Status | None) -> LimitsForm:
    """The form as a person sent it, held against what is saved.

    A field that still holds what it was made with asks for nothing, so a limit that somebody else has set meanwhile is
    not set back by a form that only wanted another one.
    """
    form = fresh(profile, status)
    form.seen |= {name: text for name in form.seen if (text := _one(sent, f"seen_{name}")) is not None}
    for name in profiles.LIMITS:
        _take(form, name, sent, profile[name])
    limits: Mapping[str, Bound] = status.limits if status else {}
    for name, words in profiles.outside(form.asked, profile, limits).items():
        form.errors[name] = f"{form.texts[name]!r}: {words}"
    _take_angles(form, sent, profile, status)
    if form.errors:
        form.notice = "Nothing was changed, nothing was started: see beside the field."
    return form


def _take_angles(form: LimitsForm, sent: FormData, profile: Mapping[str, Any], status: Status | None) -> None:
    """The range of angles, where the form has its fields."""
    given = {name: text[:LONGEST_SHOWN] for name in angle_form.NAMES if (text := _one(sent, name)) is not None}
    if len(given) < len(angle_form.NAMES) or given.items() <= form.seen.items():
        return
    asked, errors = angle_form.asked(given, profile, status)
    rigs = (status.angle.range_rad if status else None) or (angles.LEAST_RAD, angles.MOST_RAD)
    if beyond := angles.outside(asked, rigs):
        errors[angle_form.NAMES[1]] = beyond[angles.RANGE]
    form.texts |= given
    form.errors |= errors
    form.asked |= {} if errors else asked


def _take(form: LimitsForm, name: str, sent: FormData, saved: float) -> None:
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
    found = []
    for name in profiles.LIMITS:
        words = profiles.takes(name, status.limits if status else {})
        found.append({"name": name, "label": LABELS[name], "help": words})
    return found + angle_form.fields(status)


LABELS = {
    "current_ma": "Current of every pulse (mA)",
    "max_pulse_width_us": "Comfort maximum (µs)",
    "max_torque_nm": "Torque that stops a test (N·m)",
}
