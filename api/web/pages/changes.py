"""What has changed since a page was shown, side by side, and the decision offered anew on what is there now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fastapi import Request

from api import decisions
from api.clinical_words import decision_words
from api.language import _, lazy, localised, plain, translated
from api.people.auth import Principal, Scope
from api.sessions import angles, profiles
from api.store.seen import MOST_TOLD, ChangedError
from api.web.pages.limits_form import LABELS
from api.web.pages.starting import site_words

KEPT_OUT = ("csrf", "seen", "password", "latch")
"""Fields of a form that are not sent again as they were."""
ALL_THE_SAME = lazy("Do it all the same")
BUTTONS = {
    "approve": lazy("Approve all the same"), "reject": lazy("Reject all the same"), "undo": lazy("Undo all the same"),
    "profile": lazy("Set the limits all the same"), "rearm": lazy("I have seen this and checked: re-arm"),
}  # fmt: skip
DECIDED = {"approve": "approved", "reject": "rejected"}


@dataclass(frozen=True)
class Row:
    """A change: what, what was shown, what is there now, and who did it when."""

    what: str
    before: str
    now: str
    who: str
    at_utc: str


@dataclass(frozen=True)
class Again:
    """The form once more: what is pressed now is a new decision."""

    action: str
    hidden: list[tuple[str, str]]
    asked: list[str]
    """What was typed of a participant's limits."""
    password: bool
    button: str


def rows(changes: list[dict[str, Any]]) -> list[Row]:
    """Each change in words."""
    found = []
    for change in changes:
        now = change["now"]
        before, after = (words(entry, now["action"]) for entry in (change["seen"], now))
        found.append(Row(what(now), before, after, now["who"], now["at_utc"]))
    return found


def what(entry: dict[str, Any]) -> str:
    """What an entry is about."""
    names = {"set profile": _("Limits"), "finish calibration": _("Limits"), "set muscle": _("Side and muscle"),
             "approve": _("Model"), "reject": _("Model"), "latched": _("The rig")}  # fmt: skip
    return f"{names.get(entry['action'], _('Change'))} {entry['subject']}".removesuffix(" rig")


def words(entry: dict[str, Any] | None, of: str) -> str:
    """What an entry has set of what the action `of` sets."""
    if entry is None:
        return _("nothing decided")
    detail = entry["detail"]
    if entry["action"] in DECIDED:
        return ": ".join(part for part in (decision_words(DECIDED[entry["action"]]), detail.get("reason")) if part)
    if entry["action"] == "latched":
        return translated(detail["reason"])
    if of == "set muscle":
        return site_words((detail.get("side"), detail.get("muscle"), detail.get("placement")))
    if detail.get("profile"):
        return limits(detail["profile"])
    return translated(entry["action"])


def limits(profile: dict[str, Any]) -> str:
    """A participant's limits."""
    known = {name: limit.unit for name, limit in profiles.LIMITS.items() if profile.get(name) is not None}
    found = [localised(f"{profile[name]:g} {unit}") for name, unit in known.items()]
    range_rad = angles.of(profile)
    return ", ".join([*found, *([] if range_rad is None else [angles.words(range_rad)])])


def for_reader(changes: list[dict[str, Any]], who: Principal | None) -> list[dict[str, Any]]:
    """The same without what is for those who may approve: why a model was approved or rejected."""
    if who is not None and who.may(Scope.APPROVE_MODEL):
        return changes
    return [{name: _without_reason(entry) for name, entry in change.items()} for change in changes]


def _without_reason(entry: dict[str, Any] | None) -> dict[str, Any] | None:
    if entry is None or entry["action"] not in DECIDED:
        return entry
    return {**entry, "detail": {}}


async def again(request: Request, problem: ChangedError) -> Again | None:
    """The form that was sent, to be sent again on what is there now; None where it cannot be: a file, a question.

    Nor is it where not every change is shown.
    """
    found = decisions.find(request.method, request.url.path)
    all_told = 0 < len(problem.extra["changes"]) < MOST_TOLD
    if found is None or not all_told or "form" not in request.headers.get("content-type", ""):
        return None
    sent = (await request.form()).multi_items()
    if any(not isinstance(value, str) for _name, value in sent):
        return None
    hidden = [(name, str(value)) for name, value in sent if name not in KEPT_OUT]
    if found[0].field == "latch":
        hidden.append(("latch", problem.extra["latch"]))
    button = str(BUTTONS.get(request.url.path.rpartition("/")[2], ALL_THE_SAME))
    texts = dict(hidden)
    typed = [f"{plain(label)} {texts[name]}" for name, label in LABELS.items()
             if name in texts and texts[name] != texts.get(f"seen_{name}")]  # fmt: skip
    return Again(request.url.path, hidden, typed, any(name == "password" for name, _value in sent), button)
