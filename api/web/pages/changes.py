"""What has changed since a page was shown, side by side, and the decision offered anew on what is there now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fastapi import Request

from stimrig.api import decisions
from stimrig.api.clinical_words import WORDS
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.sessions import profiles
from stimrig.api.store.seen import MOST_TOLD, ChangedError
from stimrig.api.web.pages.starting import site_words

KEPT_OUT = ("csrf", "seen", "password", "latch")
"""Fields of a form that are not sent again as they were."""
ALL_THE_SAME = "Do it all the same"
BUTTONS = {
    "approve": "Approve all the same", "reject": "Reject all the same", "undo": "Undo all the same",
    "profile": "Set the limits all the same", "muscle": "Set this side and muscle all the same",
    "keys": "Make the key all the same", "rearm": "I have seen this and checked: re-arm",
}  # fmt: skip
ARCHIVED = {"create participant": "not in the archive", "archive": "in the archive",
            "unarchive": "not in the archive"}  # fmt: skip
PLAN = {"duration": ("max_duration_s", "s"), "current": ("current_ma", "mA"), "width": ("max_pulse_width_us", "µs")}
"""Fields of a key's form, with their units."""
DECIDED = {"approve": WORDS["decision"]["approved"], "reject": WORDS["decision"]["rejected"]}


@dataclass(frozen=True)
class Row:
    """A change: what, what was shown, what is there now, and who did it when."""

    what: str
    before: str
    now: str
    who: str
    at_utc: str
    before_utc: str = ""
    """Since when it was so."""
    at: str = ""
    """Address of a page that tells more of it."""


@dataclass(frozen=True)
class Again:
    """The form once more: what is pressed now is a new decision."""

    action: str
    hidden: list[tuple[str, str]]
    asked: list[str]
    """What was wanted."""
    password: bool
    button: str


def rows(changes: list[dict[str, Any]]) -> list[Row]:
    """Each change in words."""
    found = []
    for change in changes:
        now = change["now"]
        before, after = (words(entry, now["action"]) for entry in (change["seen"], now))
        since_utc = change["seen"]["at_utc"] if change["seen"] else ""
        at = f"/models/{now['subject']}" if now["action"] in DECIDED else ""
        found.append(Row(what(now), before, after, now["who"], now["at_utc"], since_utc, at))
    return found


def what(entry: dict[str, Any]) -> str:
    """What an entry is about."""
    names = {"set profile": "Limits", "finish calibration": "Limits", "set muscle": "Side and muscle",
             "archive": "Archive", "unarchive": "Archive", "latched": "The rig"}  # fmt: skip
    if entry["action"] in DECIDED:
        return model_words(entry["subject"])
    return f"{names.get(entry['action'], 'Change')} {entry['subject']}".removesuffix(" rig")


def model_words(model_id: str) -> str:
    """A model as its pages head it."""
    return f"{'Model'} {model_id[:8]}"


def words(entry: dict[str, Any] | None, of: str) -> str:
    """What an entry has set of what the action `of` sets."""
    if entry is None:
        return "nothing decided"
    detail = entry["detail"]
    if entry["action"] in DECIDED:
        return ": ".join(part for part in (DECIDED[entry["action"]], detail.get("reason")) if part)
    if of in ARCHIVED and entry["action"] in ARCHIVED:
        return ARCHIVED[entry["action"]]
    if detail.get("ran_by"):
        return str(detail["ran_by"])
    if entry["action"] == "latched":
        return detail["reason"]
    if of == "set muscle":
        return site_words((detail.get("side"), detail.get("muscle"), detail.get("placement")))
    if detail.get("profile"):
        return limits(detail["profile"])
    return entry["action"]


def limits(profile: dict[str, Any]) -> str:
    """A participant's limits."""
    known = {name: limit.unit for name, limit in profiles.LIMITS.items() if profile.get(name) is not None}
    found = [f"{profile[name]:g} {unit}" for name, unit in known.items()]
    range_rad = profiles.range_of(profile)
    return ", ".join([*found, *([] if range_rad is None else [profiles.range_words(range_rad)])])


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

    Nor is it where not every change is shown, or of a calibration: that goes no further on limits of another one.
    """
    found = decisions.find(request.method, request.url.path)
    all_told = 0 < len(problem.extra["changes"]) < MOST_TOLD
    by_form = "form" in request.headers.get("content-type", "")
    if found is None or found[0].field == "calibration" or not all_told or not by_form:
        return None
    sent = (await request.form()).multi_items()
    if any(not isinstance(value, str) for _name, value in sent):
        return None
    hidden = [(name, str(value)) for name, value in sent if name not in KEPT_OUT]
    if found[0].field == "latch":
        hidden.append(("latch", problem.extra["latch"]))
    action = request.url.path.rpartition("/")[2]
    button = BUTTONS.get(action, ALL_THE_SAME)
    asked = wanted(action, found[1], dict(hidden))
    return Again(request.url.path, hidden, asked, any(name == "password" for name, _value in sent), button)


def wanted(action: str, names: dict[str, str], texts: dict[str, str]) -> list[str]:
    """What the form asks for: it is not looked at again on the page that it came from."""
    if action == "muscle":
        return [site_words((texts.get("side"), texts.get("muscle"), texts.get("placement")))]
    if action in ARCHIVED:
        return [ARCHIVED[action]]
    if "model_id" in names:
        model, decided = model_words(names["model_id"]), DECIDED.get(action)
        return [model if decided is None else f"{model}: {decided}"]
    if "ran_by" in texts:
        return [texts["ran_by"]]
    if action == "keys":
        plan = {name: f"{texts.get(field, '')} {unit}" for name, (field, unit) in PLAN.items()}
        plan["trials"] = texts.get("trials", "")
        return [
            texts.get("name", ""),
            "trials: {trials} of at most {duration}, {current}, {width}".format(**plan),
        ]
    return [f"{limit.label} {texts[name]}" for name, limit in profiles.LIMITS.items()
            if name in texts and texts[name] != texts.get(f"seen_{name}")]  # fmt: skip
