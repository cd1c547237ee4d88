"""The audit trail: append-only, each entry holding the hash of the one before; and what every chain is made with."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from stimrig.api.store.tables import AuditEntry


def entry_hash(entry: dict[str, Any]) -> str:
    """SHA-256 of an entry's canonical JSON, its own hash left out."""
    hashed = {key: value for key, value in entry.items() if key != "hash"}
    return digest(json.dumps(hashed, sort_keys=True, separators=(",", ":")))


def write(session: Session, at_utc: str, actor: str, action: str, subject: str, **detail: Any) -> AuditEntry:
    """Append an entry in the caller's transaction, so that action and entry stand or fall together."""
    last = newest(session)
    fields = {
        "seq": last.seq + 1 if last else 1,
        "at_utc": at_utc,
        "who": storable(actor),
        "action": action,
        "subject": storable(subject),
        "detail": detail,
        "previous_hash": last.hash if last else GENESIS,
    }
    entry = AuditEntry(**fields, hash=entry_hash(fields))
    session.add(entry)
    session.flush()
    return entry


def newest(session: Session) -> AuditEntry | None:
    """Return the trail's last entry."""
    return session.scalars(select(AuditEntry).order_by(AuditEntry.seq.desc()).limit(1)).first()


ERASED, ERASE = "(erased)", "erase participant"
"""Subject of an entry whose content was taken away, and the action of the entry that vouches for what is left of it."""
ACCOUNTS = ("add user", "change password", "remove user")
ON_ACCOUNTS = (*ACCOUNTS, "issue token", "revoke token")
"""Actions whose subject is the name of a user or a key."""


def erase(session: Session, names: set[str], at_utc: str, actor: str, **detail: Any) -> None:
    """Take away the content of entries that name one of these, and append the entry that vouches for what is left.

    Number, time, person, action and hash of an entry stay, so that the trail stays a chain. A participant's code may
    also be a word of the trail or the name of an account: entries of those stay.
    """
    last, erased = newest(session), []
    subjects = names - {"page", "rig"}  # those of the trail's own words that are no participants
    for entry in session.scalars(select(AuditEntry).order_by(AuditEntry.seq)):
        named = entry.subject in subjects and entry.action not in ON_ACCOUNTS
        if entry.action != ERASE and (named or _mentions(entry.detail, names)):
            entry.subject, entry.detail = ERASED, {"erased": last.seq + 1 if last else 1}
            if names & {entry.who, *entry.who.split(" ")}:  # what a test does by itself goes by its id
                entry.who = ERASED
            erased.append(entry)
    session.flush()
    write(session, at_utc, actor, ERASE, "a participant", **detail, entries=len(erased), kept=left_of(erased))


def _mentions(value: Any, names: set[str]) -> bool:
    """Return whether a value names one of these, at whatever depth. Keys and scopes are words of the trail."""
    if isinstance(value, dict):
        return any(_mentions(part, names) for key, part in value.items() if key != "scopes")
    if isinstance(value, list):
        return any(_mentions(part, names) for part in value)
    return isinstance(value, str) and value in names


def left_of(entries: list[AuditEntry]) -> str:
    """Return the digest of the fields that blanked entries keep."""
    return digest(canonical([[entry.seq, entry.at_utc, entry.who, entry.action, entry.hash] for entry in entries]))


def vouched(entries: list[AuditEntry]) -> set[int]:
    """Return the numbers of blanked entries that a later, valid entry vouches for."""
    numbers: set[int] = set()
    for entry in entries:
        if entry.action == ERASE and entry.hash == entry_hash(entry.as_dict()):
            blanked = [
                blank_entry
                for blank_entry in entries
                if blank_entry.seq < entry.seq and blank(blank_entry) == entry.seq
            ]
            if len(blanked) == entry.detail.get("entries") and left_of(blanked) == entry.detail.get("kept"):
                numbers |= {blank_entry.seq for blank_entry in blanked}
    return numbers


def blank(entry: AuditEntry) -> int | None:
    """Return the number of the entry that blanked this one; None: it has its content."""
    return entry.detail["erased"] if entry.subject == ERASED and list(entry.detail) == ["erased"] else None


def first_broken(entries: list[AuditEntry]) -> int | None:
    """The sequence number of the first entry that does not hold, or None if the chain is whole."""
    previous, erased = GENESIS, vouched(entries)
    for number, entry in enumerate(entries, start=1):
        sound = entry.seq in erased or entry.hash == entry_hash(entry.as_dict())
        if entry.seq != number or entry.previous_hash != previous or not sound:
            return entry.seq
        previous = entry.hash
    return None


GENESIS = "0" * 64


def canonical(value: Any) -> str:
    """JSON with sorted keys and no spaces: what is hashed. Raises ValueError for what has no such text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest(text: str) -> str:
    """SHA-256 in hex. Raises ValueError where UTF-8 cannot hold the text."""
    return hashlib.sha256(text.encode()).hexdigest()


def storable(text: str) -> str:
    """The text without what PostgreSQL or UTF-8 does not take, so that what somebody sent can be written down."""
    return text.replace("\x00", "\ufffd").encode("utf-8", "replace").decode()
