"""Optimistic locking: a decision is refused (412) once what it was made on has another version.

A row's version is the number of the audit entry of the last decision about it: the entry's place in the trail and 24
bits of its hash. So a database that was restored from a backup takes no version that was shown before it. Clients send
the version back as `If-Match` (RFC 9110, section 13.1.1). `check` runs in the decision's own transaction.
"""

from __future__ import annotations

import re
from typing import Any

from sqlalchemy import ColumnElement, and_, or_, select, update
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError
from stimrig.api.store import audit
from stimrig.api.store.tables import AuditEntry, Participant, User

Tags = tuple[str, ...]
"""Entity tags of a request's `If-Match`, without their quotes."""
Versioned = Participant | User
HASH_DIGITS = 6
LIMITS, SITE = ("create participant", "set profile", "finish calibration"), ("create participant", "set muscle")
MODELS = ("approve", "reject")
SETTINGS = (*LIMITS, "set muscle")
POSES = ("pose of the angle sensor", "calibrate the angle sensor")
OF_POSES = and_(AuditEntry.subject == "rig", AuditEntry.action.in_(POSES))
UNITS = {"_ma": "mA", "_us": "µs", "_nm": "N·m", "_rad": "rad"}
MOST_CHANGES = 20  # that a refusal lists, the newest


def number_of(entry: AuditEntry) -> int:
    """Return the version that an audit entry stands for."""
    return entry.seq << 4 * HASH_DIGITS | int(entry.hash[:HASH_DIGITS], 16)


def write(session: Session, row: Versioned, at_utc: str, actor: str, action: str, subject: str, **detail: Any) -> None:
    """Write a decision's audit entry and make it the version of the row that was decided on."""
    row.version = number_of(audit.write(session, at_utc, actor, action, subject, **detail))


def write_pose(session: Session, at_utc: str, actor: str, action: str, **detail: Any) -> int:
    """Write an entry about the angle sensor: its version. Ranges of angles rest on it: all participants get it, too."""
    version = number_of(audit.write(session, at_utc, actor, action, "rig", **detail))
    session.execute(update(Participant).values(version=version))
    return version


def pose_version(session: Session) -> int:
    """Return the version of the angle sensor's calibration; 0 where there is none."""
    entry = session.scalars(select(AuditEntry).where(OF_POSES).order_by(AuditEntry.seq.desc()).limit(1)).first()
    return 0 if entry is None else number_of(entry)


def check(session: Session, row: Versioned | None, tags: Tags | None) -> int:
    """Return the version of a row, or with None of the angle sensor; without tags nothing is checked.

    Raises ChangedError: it is not among the tags; with each change since: who, when, what it was and what it is.
    """
    version, entries = (pose_version(session), OF_POSES) if row is None else (row.version, about(row))
    if tags is not None and str(version) not in tags:
        numbers = [int(tag) for tag in tags if re.fullmatch(r"\d{1,18}", tag, re.ASCII)]
        raise ChangedError(version, since(session, max(numbers, default=-1), entries))
    return version


def since(session: Session, version: int, entries: ColumnElement[bool]) -> list[dict[str, Any]]:
    """Return the changes after a version, the newest last; none where this trail does not have it."""
    if version and not is_known(session, version):
        return []
    place = version >> 4 * HASH_DIGITS
    later = select(AuditEntry).where(AuditEntry.seq > place, entries).order_by(AuditEntry.seq)
    return [_change(session, place, entry) for entry in session.scalars(later)]


def is_known(session: Session, version: int) -> bool:
    """Return whether this trail has the version; one that was shown by another database is not known."""
    entry = session.get(AuditEntry, version >> 4 * HASH_DIGITS)
    return entry is not None and number_of(entry) == version


def settings_of(code: str) -> ColumnElement[bool]:
    """Return the condition for entries about a participant's limits and site."""
    return and_(AuditEntry.subject == code, AuditEntry.action.in_(SETTINGS))


def about(row: Versioned) -> ColumnElement[bool]:
    """Return the condition for entries of decisions about a row."""
    if isinstance(row, User):
        return and_(AuditEntry.subject == row.name, AuditEntry.action.in_(audit.ACCOUNTS))
    of_participant = AuditEntry.detail["participant"].as_string() == row.code
    decided = and_(of_participant, AuditEntry.action.in_((*MODELS, "issue token")))
    return or_(settings_of(row.code), decided, OF_POSES)


def _change(session: Session, place: int, entry: AuditEntry) -> dict[str, Any]:
    actions = next((group for group in (LIMITS, SITE, MODELS) if entry.action in group), (entry.action,))
    same = AuditEntry.subject == entry.subject, AuditEntry.action.in_(actions), AuditEntry.seq <= place
    before = session.scalars(select(AuditEntry).where(*same).order_by(AuditEntry.seq.desc()).limit(1)).first()
    old, new = _values(before, actions), _values(entry, actions)
    fields = {name: getattr(entry, name) for name in ("who", "at_utc", "action", "subject")}
    return {**fields, "old": _words(old, new), "new": _words(new, old)}


def _values(entry: AuditEntry | None, actions: tuple[str, ...]) -> dict[str, Any]:
    if entry is None:
        return {}
    if actions is LIMITS:
        return entry.detail.get("profile") or {}
    if actions is SITE:
        return {name: entry.detail.get(name) for name in ("side", "muscle", "placement")}
    return {"": entry.action}


def _words(values: dict[str, Any], other: dict[str, Any]) -> str:
    """Say the values that differ, with their units: "current 5 mA, max pulse width 200 µs"."""
    words = []
    for name, value in values.items():
        ending = next((ending for ending in UNITS if name.endswith(ending)), "")
        if value is not None and value != other.get(name):
            words.append(f"{name.removesuffix(ending).replace('_', ' ')} {value} {UNITS.get(ending, '')}".strip())
    return ", ".join(words)


class ChangedError(ApiError):
    """412: what was decided on has another version now; the answer's `ETag` has it."""

    def __init__(self, version: int | str, changes: list[dict[str, Any]], detail: str = "") -> None:
        what = "{who}: {action} {subject}, {at_utc}. ".format(**changes[-1]) if changes else ""
        detail = detail or f"{what}Nothing was done. Look at what is there now; what you decide then is a new decision."
        title, changes = "This was changed since you saw it", changes[-MOST_CHANGES:]
        super().__init__(412, "changed-meanwhile", title, detail, changes=changes)
        self.headers["ETag"] = f'"{version}"'
