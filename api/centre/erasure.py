"""Taking away what a centre keeps of a participant: rows, what items said, and files that nobody else's item names."""

from __future__ import annotations

import secrets
from typing import Any

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from stimrig.api.centre.bucket import Bucket
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, require_found
from stimrig.api.store import Store, audit
from stimrig.api.store.centre_tables import (
    CentreDecision,
    CentreEffect,
    CentreFile,
    CentreItem,
    CentreModel,
    CentreParticipant,
    CentreRecording,
    CentreRig,
    CentreSession,
    CentreTest,
    CentreWanted,
)
from stimrig.api.store.tables import Erasure

OF_PERSON = (
    CentreEffect, CentreDecision, CentreModel, CentreRecording, CentreTest, CentreSession,
)  # fmt: skip
KEYED = {"recording": CentreRecording.recording_id, "model": CentreModel.id, "test": CentreTest.id}


def erase(
    store: Store, bucket: Bucket, clock: Clock, code: str, reason: str, by: str, all_rigs: bool = False
) -> dict[str, Any]:
    """Take it away; how many rows and files went. Cut off, the same command goes on with the files.

    Raises NotFoundError: no such participant, and nothing that was begun. ApiError: 409 several rigs told of the code,
    and it was not said that all are meant. BucketError: a file cannot be removed.
    """
    with store.write() as session:
        there = session.scalars(select(CentreParticipant).where(CentreParticipant.code == code)).first()
        if there is not None:
            if not all_rigs:
                _refuse_several(session, code)
            _rows(session, code, reason, by, clock.utc())
        begun = list(session.scalars(select(Erasure).where(Erasure.of == code, Erasure.done_utc.is_(None))))
    require_found(begun or None, "participant", code, "GET /v1/participants lists them.")
    for row in begun:
        for sha256 in row.files:
            bucket.remove(sha256)
        with store.write() as session:
            done = session.get(Erasure, row.id)
            if done is not None:  # the code goes with the last file
                done.files, done.of, done.done_utc = [], audit.ERASED, clock.utc()
    return {"erasure": begun[-1].id, "files": sum(len(row.files) for row in begun)}


def _refuse_several(session: Session, code: str) -> None:
    """A code is one person at a centre; two clinics that gave it to two people must not lose the other one."""
    told = {item.rig_id for item in _items(session, code)}
    if len(told) > 1:
        names = session.scalars(select(CentreRig.name).where(CentreRig.id.in_(told)).order_by(CentreRig.name)).all()
        detail = f"{code}: told by {', '.join(names)}. If that is one person, give --all-rigs; else erase at the rigs."
        raise ApiError(409, "several-rigs", "Several rigs told of it", detail)


def _rows(session: Session, code: str, reason: str, by: str, now_utc: str) -> None:
    """The rows, and an intent with the files that nobody else's item names."""
    items = _items(session, code)
    files = {item.file for item in items if item.file}
    for item in items:
        item.body, item.key = None, audit.ERASED
    session.flush()
    places = {(item.rig_id, item.chain, item.seq) for item in items}
    others = select(CentreItem.rig_id, CentreItem.chain, CentreItem.seq, CentreItem.file)
    for rig_id, chain, seq, file in session.execute(others.where(CentreItem.file.in_(files))).all():
        if (rig_id, chain, seq) not in places:
            files.discard(file)
    counts = {"items": len(items)}
    for table in OF_PERSON:
        own = table.participant == code
        counts[table.__tablename__] = session.scalar(select(func.count()).select_from(table).where(own)) or 0
        session.execute(delete(table).where(own))
    session.execute(delete(CentreParticipant).where(CentreParticipant.code == code))
    session.execute(delete(CentreWanted).where(CentreWanted.sha256.in_(files)))
    session.execute(delete(CentreFile).where(CentreFile.sha256.in_(files)))
    row = Erasure(id=secrets.token_hex(6), of=code, reason=reason, asked_by=by, asked_utc=now_utc, files=sorted(files))
    session.add(row)
    session.flush()
    audit.write(session, now_utc, by, audit.ERASE, row.id, reason=reason, rows=counts)


def _items(session: Session, code: str) -> list[CentreItem]:
    """All items that tell of the participant, by their keys or, of decisions and trials, by what they say."""
    found = {}
    for kind, column in {**KEYED, "participant": None}.items():
        own = None if column is None else select(column).where(column.class_.participant == code)
        keys = [code] if own is None else list(session.scalars(own))
        kinds = ("test", "tracked") if kind == "test" else (kind,)
        for item in session.scalars(select(CentreItem).where(CentreItem.kind.in_(kinds), CentreItem.key.in_(keys))):
            found[item.rig_id, item.chain, item.seq] = item
    said = f'"participant":"{code}"'
    for item in session.scalars(select(CentreItem).where(CentreItem.body.contains(said, autoescape=True))):
        if said in (item.body or ""):  # SQLite's LIKE takes P1 and p1 for the same
            found[item.rig_id, item.chain, item.seq] = item
    return list(found.values())
