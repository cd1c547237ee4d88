"""The form in which a person sets a participant's limits: what was typed, what is wrong with it, what it changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from starlette.datastructures import FormData

from api.sessions import profiles
from api.sessions.questions import Row
from api.web.pages import typed
from rig.messages import Bound, Status

LONGEST_SHOWN = 60


@dataclass
class LimitsForm:
    """The form, as it is shown or was sent.

    Parameters
    ----------
    version : str
        Of the limits that it was made from.
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
    theirs : list of Row
        Where somebody else was quicker: what was typed, and what is saved.
    """

    version: str
    texts: dict[str, str]
    seen: dict[str, str]
    asked: dict[str, float] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    notice: str = ""
    theirs: list[Row] = field(default_factory=list)


def fresh(profile: Mapping[str, Any]) -> LimitsForm:
    """The form with what is saved."""
    texts = {name: typed.shown(profile[name]) for name in profiles.LIMITS}
    return LimitsForm(profiles.version(profile), texts, dict(texts))


def read(sent: FormData, profile: Mapping[str, Any], limits: Mapping[str, Bound]) -> LimitsForm:
    """The form as a person sent it, held against what is saved.

    A field that still holds what it was made with asks for nothing, so a limit that somebody else has set meanwhile is
    not set back by a form that only wanted another one.
    """
    form = fresh(profile)
    if _one(sent, "version") not in (None, form.version):
        return _stale(form, sent)
    for name in profiles.LIMITS:
        _take(form, name, sent, profile[name])
    for name, words in profiles.outside(form.asked, profile, limits).items():
        form.errors[name] = f"{form.texts[name]!r}: {words}"
    if form.errors:
        form.notice = "Nothing was changed, nothing was started: see beside the field."
    return form


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


def _stale(form: LimitsForm, sent: FormData) -> LimitsForm:
    form.notice = "Nothing was saved, nothing was started. The limits were changed"
    for name, limit in profiles.LIMITS.items():
        text = _one(sent, name)
        if text is None or text == _one(sent, f"seen_{name}"):
            continue
        form.texts[name] = text[:LONGEST_SHOWN]
        form.theirs.append(Row(f"{limit.words.capitalize()} ({limit.unit})", form.texts[name], form.seen[name]))
    return form


def _one(sent: FormData, name: str) -> str | None:
    value = sent.get(name)
    return value if isinstance(value, str) else None


def fields(status: Status | None) -> list[dict[str, str]]:
    """What the fields are called, and what this rig takes in them."""
    found = []
    for name in profiles.LIMITS:
        words = profiles.takes(name, status.limits if status else {})
        found.append({"name": name, "label": LABELS[name], "help": words})
    return found


LABELS = {
    "current_ma": "Current of every pulse (mA)",
    "max_pulse_width_us": "Comfort maximum (µs)",
    "max_torque_nm": "Torque that stops a test (N·m)",
}
