"""The chain of items: what their hashes are of, where it ends, and how it begins."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from stimrig.api.store.audit import GENESIS, canonical, digest
from stimrig.api.store.tables import OutboxItem

BEGIN = "begin"
HASHED = ("seq", "kind", "key", "sha256", "file", "file_bytes", "at_utc", "previous")
AT_ONCE = 200
"""Keys that are looked for with one query."""


@dataclass(frozen=True)
class Position:
    """A place in a chain: an item's number and hash."""

    seq: int
    hash: str


NOWHERE = Position(0, GENESIS)


@dataclass(frozen=True)
class Head:
    """The newest item: the end of the chain that is pushed."""

    chain: str
    seq: int
    hash: str


@dataclass(frozen=True)
class Telling:
    """What an item says, before it has its place in the chain."""

    kind: str  # what it tells of
    key: str  # the id of the row
    body: dict[str, Any]  # what it tells
    file: str | None = None  # SHA-256 of the file that belongs to it
    file_bytes: int | None = None  # the file's length; None with a file: the file is not to be found at the moment


def item_hash(fields: dict[str, Any]) -> str:
    return digest(canonical({name: fields[name] for name in HASHED}))


NEWEST = select(OutboxItem.chain, OutboxItem.seq, OutboxItem.hash).order_by(OutboxItem.id.desc()).limit(1)
"""Asked for every second: put together once."""


def head(session: Session) -> Head | None:
    """The newest item, or None where nothing was ever told."""
    row = session.execute(NEWEST).first()
    return None if row is None else Head(*row)


def at(session: Session, chain: str, seq: int) -> str | None:
    """The hash of an item, or None where there is no such item."""
    if seq == 0:
        return GENESIS
    return session.scalar(select(OutboxItem.hash).where(OutboxItem.chain == chain, OutboxItem.seq == seq))


def begin(session: Session, at_utc: str, after: Head | None = None) -> Head:
    """A new chain, the first one or after another; its first item."""
    chain = secrets.token_hex(16)
    said = None if after is None else {"chain": after.chain, "seq": after.seq}
    return _append(session, Head(chain, 0, GENESIS), at_utc, Telling(BEGIN, chain, {"after": said}))


def put(session: Session, at_utc: str, tellings: Iterable[Telling]) -> int:
    """Append what is not the newest item of its row already, in the caller's transaction; how many were appended."""
    tellings = list(tellings)
    if not tellings:
        return 0
    end = head(session) or begin(session, at_utc)
    new = unlike_newest(session, tellings)
    for telling in new:
        end = _append(session, end, at_utc, telling)
    return len(new)


def unlike_newest(session: Session, tellings: Sequence[Telling]) -> list[Telling]:
    """Those that are not the newest item of their row."""
    end = head(session)
    known = newest(session, end.chain, tellings) if end else {}
    return [telling for telling in tellings if not same(telling, known.get((telling.kind, telling.key)))]


def newest(session: Session, chain: str, tellings: Sequence[Telling]) -> dict[tuple[str, str], tuple[str, str | None]]:
    """For each row that is told of: digest of the body and file of its newest item in a chain."""
    found: dict[tuple[str, str], tuple[str, str | None]] = {}
    for kind in {telling.kind for telling in tellings}:
        keys = sorted({telling.key for telling in tellings if telling.kind == kind})
        for start in range(0, len(keys), AT_ONCE):
            one_of = OutboxItem.key.in_(keys[start : start + AT_ONCE])
            last = select(func.max(OutboxItem.id)).where(
                OutboxItem.kind == kind, one_of, OutboxItem.chain == chain
            ).group_by(OutboxItem.key)  # fmt: skip
            columns = (OutboxItem.key, OutboxItem.sha256, OutboxItem.file)
            for key, sha256, file in session.execute(select(*columns).where(OutboxItem.id.in_(last))):
                found[kind, key] = (sha256, file)
    return found


def same(telling: Telling, known: tuple[str, str | None] | None) -> bool:
    """Whether a row's newest item says this already; that its file is out of its place is no news of the row."""
    if known is None or known[0] != digest(canonical(telling.body)):
        return False
    return telling.file_bytes is None or known[1] == telling.file


def _append(session: Session, end: Head, at_utc: str, telling: Telling) -> Head:
    body = canonical(telling.body)
    there = telling.file is not None and telling.file_bytes is not None
    fields: dict[str, Any] = {
        "seq": end.seq + 1,
        "kind": telling.kind,
        "key": telling.key,
        "sha256": digest(body),
        "file": telling.file if there else None,
        "file_bytes": telling.file_bytes if there else None,
        "at_utc": at_utc,
        "previous": end.hash,
    }
    told = Head(end.chain, end.seq + 1, item_hash(fields))
    session.add(OutboxItem(chain=end.chain, body=body, hash=told.hash, **fields))
    session.flush()
    return told
