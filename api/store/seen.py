"""What was seen when somebody decided, and what has changed since: the one place where that is judged.

Every change writes an entry into the audit trail, in its own transaction. So the number of the newest entry says all
that a page or a document rested on, and a decision holds if the trail has no later entry about its subject. The number
goes out as an entity tag (RFC 9110, section 8.8.3) and as a field of each form, and comes back with the decision
(`If-Match`, section 13.1.1). `check` is called in the decision's own transaction, where nothing can come between.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, and_, or_, select
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError
from stimrig.api.store.tables import AuditEntry, Model

About = ColumnElement[bool]
"""Which entries of the trail a decision rests on."""
SETTINGS = ("create participant", "set profile", "set muscle", "archive", "unarchive", "finish calibration")
DECISIONS = ("approve", "reject")
ACCOUNTS = ("add user", "change password", "revoke token")
POSES = ("pose of the angle sensor", "calibrate the angle sensor")
RIGHTS = (*DECISIONS, "revoke token", "set muscle", "archive")
"""Entries with which a right ends that a controller plays by."""
ENTRY, MARK = r"(\d{1,9})", r"([0-9a-f]{8})"
"""A place as it is written; a number that a database has."""
MOST_TOLD = 20
"""Changes that are told, the newest."""


@dataclass(frozen=True)
class Seen:
    """A place in the trail, and the day: approvals and calibrations end with it."""

    entry: int  # number of the newest entry at that time; 0: there was none
    mark: str  # begin of that entry's hash: a database that was restored has another one
    day: str  # as 2026-11-26, where the service stands

    def __str__(self) -> str:
        return f"{self.entry}.{self.mark}.{self.day}"

    def etag(self, document: str) -> str:
        """As HTTP has it, for the document at this path: the version of another one says nothing about it."""
        return f'"{self}.{mark_of(document)}"'


def mark_of(document: str) -> str:
    """What the versions of a document end in."""
    return hashlib.sha256(document.encode()).hexdigest()[:8]


def written_as_version(text: str) -> re.Match[str] | None:
    """The parts of a version of any document; None: nobody was shown this."""
    return re.fullmatch(rf"{ENTRY}\.{MARK}\.(\d{{4}}-\d\d-\d\d)(?:\.{MARK})?", text, re.ASCII)


def read(text: str, *marks: str) -> Seen | None:
    """What was sent back, with one of these documents' marks, or the empty one of a page; None where it is none."""
    found = written_as_version(text)
    if found is None or (found[4] or "") not in marks:
        return None
    return Seen(int(found[1]), found[2], found[3])


shown: ContextVar[Seen | None] = ContextVar("shown", default=None)
"""What who asks was shown, as the request says; None: its action needs none (tests/api/decisions.toml)."""
today: ContextVar[Callable[[], str] | None] = ContextVar("today", default=None)
"""Tells the day of now while somebody decides."""
looked: ContextVar[Seen | None] = ContextVar("looked", default=None)
"""The place when this request began to read what it shows: a page's forms carry it, and a question is bound to it."""
sent: ContextVar[str] = ContextVar("sent", default="")
"""The same as it came: of what the rig keeps, and of models, the version is another one."""

written: ContextVar[list[int] | None] = ContextVar("written", default=None)
"""Numbers of the entries that this request has written: its answer tells them, as `Trail-Entries`."""
own: ContextVar[tuple[str, frozenset[int]]] = ContextVar("own", default=("", frozenset()))
"""Who decides, and which entries they say they have written since (`Trail-Own`)."""


def participant(code: str) -> About:
    """Limits, site, archive and calibration of a participant."""
    return and_(AuditEntry.subject == code, AuditEntry.action.in_(SETTINGS))


def decisions(code: str) -> About:
    """Approvals and rejections of a participant's models."""
    models = select(Model.id).where(Model.participant == code)
    return and_(AuditEntry.action.in_(DECISIONS), AuditEntry.subject.in_(models))


def account(name: str) -> About:
    """A person's, a program's or a controller's right to do anything."""
    return and_(AuditEntry.subject == name, AuditEntry.action.in_(ACCOUNTS))


def revoked(*token_hashes: str | None) -> About:
    """The end of a token's right, or of that of who made it."""
    ids = [token_hash[:16] for token_hash in token_hashes if token_hash]
    ends = AuditEntry.action == "revoke token"
    return and_(ends, AuditEntry.detail["token"].as_string().in_(ids))


def accounts() -> About:
    """All of them."""
    return AuditEntry.action.in_(ACCOUNTS)


def actions_on(subject: str, *actions: str) -> About:
    """Some actions on one subject."""
    return and_(AuditEntry.subject == subject, AuditEntry.action.in_(actions))


def poses() -> About:
    """Where the angle sensor's zero and scale come from."""
    return actions_on("rig", *POSES)


def last(session: Session, *about: About) -> AuditEntry | None:
    """The newest entry about something; without `about`, of the whole trail."""
    entries = select(AuditEntry).order_by(AuditEntry.seq.desc()).limit(1)
    return session.scalars(entries.where(or_(*about)) if about else entries).first()


def newest(session: Session, day: str, *about: About) -> Seen:
    """The place of that entry."""
    found = last(session, *about)
    return Seen(0, "0" * 8, day) if found is None else at(found, day)


def at(entry: AuditEntry, day: str) -> Seen:
    """An entry's place."""
    return Seen(entry.seq, entry.hash[:8], day)


def since(session: Session, seen: Seen, *about: About) -> list[AuditEntry]:
    """The entries about something that came after what was seen, the oldest first."""
    later = select(AuditEntry).where(AuditEntry.seq > seen.entry, or_(*about))
    return list(session.scalars(later.order_by(AuditEntry.seq)))


def known(session: Session, seen: Seen) -> bool:
    """Whether it is a place in this trail."""
    place = select(AuditEntry.seq).where(AuditEntry.seq == seen.entry, AuditEntry.hash.startswith(seen.mark))
    return seen.entry == 0 or session.scalar(place) is not None


def check(session: Session, *about: About) -> None:
    """Refuse a decision on what has changed since it was shown. In the decision's own transaction.

    Raises ChangedError: with each change: what, by whom, when, and what was there before.
    """
    seen = shown.get()
    if seen is None:
        return
    refuse_another_day(seen)
    if not known(session, seen):
        detail = "This page was shown by another database than the one of now. Nothing was done. Load the page again."
        raise ChangedError([], seen, detail)  # a backup was restored, or it is of another service
    who, entries = own.get()  # what one has decided oneself meanwhile is no news; another's entry always is
    changed = [entry for entry in since(session, seen, *about) if entry.who != who or entry.seq not in entries]
    if changed:
        raise ChangedError([change(session, seen, entry) for entry in changed[-MOST_TOLD:]], seen)


def change(session: Session, seen: Seen, entry: AuditEntry) -> dict[str, Any]:
    """A change, beside what was there when the page was shown."""
    was = last(session, and_(actions_on(entry.subject, *_alike(entry.action)), AuditEntry.seq <= seen.entry))
    return {"now": entry_document(entry), "seen": None if was is None else entry_document(was)}


def _alike(action: str) -> tuple[str, ...]:
    """Actions that set what this one has set."""
    groups = (("create participant", "set profile", "finish calibration"), ("create participant", "set muscle"),
              ("create participant", "archive", "unarchive"), DECISIONS, ACCOUNTS, POSES)  # fmt: skip
    return next((group for group in groups if action in group), (action,))


def entry_document(entry: AuditEntry) -> dict[str, Any]:
    """An entry, as a problem tells it."""
    return {name: getattr(entry, name) for name in ("at_utc", "who", "action", "subject", "detail")}


class ChangedError(ApiError):
    """What a decision rests on has changed since it was shown.

    `changes`: `seen` and `now`, each an entry of the trail or None; `seen`: what was sent.
    """

    def __init__(self, changes: list[dict[str, Any]], seen: Seen | None, detail: str = "") -> None:
        if changes and not detail:
            last = changes[-1]["now"]
            detail = (
                f"{last['who']}: {last['action']} {last['subject']}, {last['at_utc']}. Nothing was done. "
                "Look at what is there now; what you decide then is a new decision."
            )
        super().__init__(409, "changed-meanwhile", "This was changed since you saw it", detail, changes=changes)
        self.extra["seen"] = None if seen is None else str(seen)


def overtaken(changed: list[AuditEntry]) -> ChangedError:
    """What a decision rests on was changed while it was carried out: nobody was shown a page between."""
    return ChangedError([{"now": entry_document(entry), "seen": None} for entry in changed], None)


def another_document(document: str) -> ChangedError:
    """What was sent is the version of something else, or of nothing."""
    detail = f"This is no version of {document}. Send the ETag with which you last saw it. Nothing was done."
    return ChangedError([], None, detail)


def refuse_another_day(seen: Seen) -> None:
    """Raise ChangedError if it was seen before midnight. Not where nobody asks: then the clock is another one's."""
    if (day := today.get()) is None or day() == seen.day:
        return
    detail = (
        f"This page is of {seen.day}. Approvals and calibrations end with their day. Nothing was done. Load the page "
        "again."
    )
    raise ChangedError([], seen, detail)
