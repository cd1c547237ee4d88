"""The audit trail: append-only, each entry holding the hash of the one before."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from stimrig.api.store.tables import AuditEntry

GENESIS = "0" * 64
ERASED, ERASE = "(erased)", "erase participant"
"""Subject of an entry whose content was taken away, and the action of the entry that vouches for what is left of it."""
ACCOUNTS = ("add user", "change password", "remove user")
ON_ACCOUNTS = (*ACCOUNTS, "issue token", "revoke token")
"""Actions whose subject is the name of a user or a key."""


def write(session: Session, at_utc: str, actor: str, action: str, subject: str, **detail: Any) -> AuditEntry:
    """Append an entry in the caller's transaction, so that action and entry stand or fall together."""
    last = newest(session)
    seq, previous = (last.seq + 1, last.hash) if last else (1, GENESIS)
    entry = AuditEntry(seq=seq, at_utc=at_utc, who=storable(actor), action=action, subject=storable(subject))
    entry.detail, entry.previous_hash = detail, previous
    entry.hash = entry_hash(entry)
    session.add(entry)
    session.flush()
    return entry


def newest(session: Session) -> AuditEntry | None:
    """Return the trail's last entry."""
    return session.scalars(select(AuditEntry).order_by(AuditEntry.seq.desc()).limit(1)).first()


def entry_hash(entry: AuditEntry) -> str:
    """SHA-256 of an entry's canonical JSON, its own hash left out."""
    return digest(canonical({name: value for name, value in entry.as_dict().items() if name != "hash"}))


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


def first_broken(entries: list[AuditEntry]) -> int | None:
    """Return the number of the first entry that does not hold; None: the chain is whole."""
    previous, blank = GENESIS, blanked(entries)
    for number, entry in enumerate(entries, start=1):
        if entry.seq != number or entry.previous_hash != previous:
            return entry.seq
        if entry.seq not in blank and entry.hash != entry_hash(entry):
            return entry.seq
        previous = entry.hash
    return None


def blanked(entries: list[AuditEntry]) -> set[int]:
    """Return the numbers of blanked entries that a later, valid entry vouches for."""
    by_eraser: dict[int, list[AuditEntry]] = {}
    for entry in entries:
        if entry.subject == ERASED and list(entry.detail) == ["erased"]:
            by_eraser.setdefault(int(entry.detail["erased"]), []).append(entry)
    numbers: set[int] = set()
    for entry in entries:
        if entry.action == ERASE and entry.hash == entry_hash(entry):
            blank = [earlier for earlier in by_eraser.get(entry.seq, []) if earlier.seq < entry.seq]
            if (len(blank), left_of(blank)) == (entry.detail.get("entries"), entry.detail.get("kept")):
                numbers |= {earlier.seq for earlier in blank}
    return numbers


def canonical(value: Any) -> str:
    """JSON with sorted keys and no spaces: what is hashed."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def digest(text: str) -> str:
    """SHA-256 in hex. Raises ValueError where UTF-8 cannot hold the text."""
    return hashlib.sha256(text.encode()).hexdigest()


def storable(text: str) -> str:
    """The text without what PostgreSQL or UTF-8 does not take, so that what somebody sent can be written down."""
    return text.replace("\x00", "\ufffd").encode("utf-8", "replace").decode()
