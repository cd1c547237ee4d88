"""From an item to the narrow tables that pages ask. What cannot be read is kept all the same, and told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from stimrig.api.centre import clean, heads, warnings
from stimrig.api.clock import local_day
from stimrig.api.outbox.messages import ItemIn
from stimrig.api.store.centre_tables import (
    CentreDecision,
    CentreEffect,
    CentreFile,
    CentreModel,
    CentreParticipant,
    CentreRecording,
    CentreRig,
    CentreSession,
    CentreTest,
    CentreWanted,
)  # fmt: skip


class Projector:
    """Takes the items of one batch, in their order, within its transaction.

    Parameters
    ----------
    session : Session
        The transaction.
    rig : CentreRig
        Whose items they are.
    now_utc : str
        When they came.
    most_file_bytes : int
        A longer file is not asked for.
    """

    def __init__(self, session: Session, rig: CentreRig, now_utc: str, most_file_bytes: int) -> None:
        self.session, self.rig, self.now_utc, self.most_file_bytes = session, rig, now_utc, most_file_bytes
        self._rows: dict[tuple[Any, ...], Any] = {}
        self._kinds: dict[str, Callable[[ItemIn, dict[str, Any]], bool]] = {
            "begin": self._begin, "participant": self._participant, "test": self._test, "recording": self._recording,
            "model": self._model, "decision": self._decision, "audit": self._audit,
        }  # fmt: skip

    def take(self, item: ItemIn) -> None:
        """Put one item where pages find it."""
        make = self._kinds.get(item.kind)
        if make is not None and not make(item, item.body):
            self._tell("unreadable", f"{item.kind} {item.seq}", of=item.kind, seq=item.seq)
        if item.file is not None:
            self._want(item.file, item.file_bytes or 0)

    def _begin(self, item: ItemIn, body: dict[str, Any]) -> bool:
        after = body.get("after")
        if isinstance(after, dict) or (self.rig.chain is not None and self.rig.chain != item.key):
            after = after if isinstance(after, dict) else {}
            known = after.get("seq")
            subject = clean.text(after.get("chain"), 32) or self.rig.chain or ""
            self._tell("restored", subject, seq=known if isinstance(known, int) and 0 <= known < 2**53 else None)
        self.rig.chain = item.key[:32]
        return True

    def _participant(self, _item: ItemIn, body: dict[str, Any]) -> bool:
        code = clean.code(body.get("code"))
        if code is None:
            return False
        row = self._person(code)
        row.side, row.muscle = clean.text(body.get("side"), 8), clean.text(body.get("muscle"), 60)
        row.archived_utc = clean.label(body.get("archived_utc"), "") or None
        return True

    def _test(self, item: ItemIn, body: dict[str, Any]) -> bool:
        code, key = clean.code(body.get("participant")), clean.text(item.key, 64)
        if code is None or not key:
            return False
        at_utc = clean.label(body.get("requested_utc"), self._at(item))
        row = self._get(CentreTest, (self.rig.id, key))
        if row is None:
            row = self._add(CentreTest(rig_id=self.rig.id, id=key, requested_utc=at_utc), (self.rig.id, key))
            self._day(code, at_utc).tests += 1
            self._day(code, at_utc).current_ma = clean.current_ma(body.get("plan"))
        row.participant, row.requested_utc = code, at_utc
        row.kind, row.state = clean.text(body.get("kind"), 40), clean.text(body.get("state"), 20)
        row.reason, row.finished_utc = clean.text(body.get("reason"), 400), clean.text(body.get("finished_utc"), 32)
        row.recording_id, row.model_id = clean.text(body.get("recording_id"), 64), clean.text(body.get("model_id"), 64)
        return True

    def _recording(self, item: ItemIn, body: dict[str, Any]) -> bool:
        code, key = clean.code(body.get("participant")), clean.text(item.key, 64)
        if code is None or not key:
            return False
        row = self._recorded(key)
        if row is None:
            at_utc = clean.label(body.get("created_utc"), self._at(item))
            row = CentreRecording(rig_id=self.rig.id, recording_id=key, participant=code, created_utc=at_utc)
            row.test_id, row.origin = clean.text(body.get("test_id"), 64), clean.text(body.get("origin"), 20)
            self._add(row, (self.rig.id, key))
            self._day(code, at_utc).recordings += 1
            self._person(code).recordings += 1
            self.rig.recordings += 1
        if item.file is None:
            return True
        if row.file is not None and row.file != item.file:
            self._tell("changed", key, kept=row.file[:12], told=item.file[:12])
            return True
        row.file, row.file_bytes = item.file, item.file_bytes
        return True

    def _model(self, item: ItemIn, body: dict[str, Any]) -> bool:
        code, key = clean.code(body.get("participant")), clean.text(item.key, 64)
        if code is None or not key:
            return False
        row = self._row(CentreModel, rig_id=self.rig.id, id=key)
        row.participant, row.created_utc = code, clean.label(body.get("created_utc"), self._at(item))
        row.recording_id = clean.text(body.get("recording_id"), 64)
        row.parent_id, row.method = clean.text(body.get("parent_id"), 64), clean.text(body.get("method"), 40)
        row.effects, row.fit = clean.effects(body.get("effects")), clean.fit(body.get("fit"))
        row.verdict = row.fit["verdict"]
        if row.file is None:
            row.file, row.file_bytes = item.file, item.file_bytes
        elif item.file not in (None, row.file):  # a version never changes
            self._tell("changed", key, kept=row.file[:12], told=str(item.file)[:12])
        for effect in row.effects:
            self._row(CentreEffect, effect=effect, participant=code, rig_id=self.rig.id)
        day = self._day_of(row)
        if day.approved_by is None and row.created_utc >= (day.model_utc or ""):
            self._stands(day, row)
        return True

    def _decision(self, item: ItemIn, body: dict[str, Any]) -> bool:
        code, model_id = clean.code(body.get("participant")), clean.text(body.get("model_id"), 64)
        approved = body.get("approved")
        if code is None or not model_id or not isinstance(approved, bool):
            return False
        key = (self.rig.id, item.sha256)
        by = clean.text(body.get("by"), 80) or "?"
        if self._get(CentreDecision, key) is None:
            row = CentreDecision(rig_id=key[0], sha256=key[1], participant=code, model_id=model_id, approved=approved)
            row.by, row.reason = by, clean.text(body.get("reason"), 400) or ""
            row.at_utc = clean.label(body.get("at_utc"), self._at(item))
            self._add(row, key)
        model = self._get(CentreModel, (self.rig.id, model_id))
        if model is None:
            return True
        day = self._day_of(model)
        if approved:
            self._stands(day, model)
            day.approved_by = by
        elif day.model_id == model_id:
            day.approved_by = None
        return True

    def _audit(self, _item: ItemIn, body: dict[str, Any]) -> bool:
        if not heads.readable(body):
            return False
        heads.compare(self.session, self.now_utc, self.rig, body)
        if body["seq"] >= (self.rig.audit_seq or 0):
            self.rig.audit_seq, self.rig.audit_hash = body["seq"], body["hash"]
        return True

    def _want(self, sha256: str, length: int) -> None:
        """Ask for a file that the centre lacks."""
        known = self._get(CentreFile, (sha256,))
        if known is not None and known.ok:
            return
        if length > self.most_file_bytes:
            self._tell("too-long", sha256[:12], megabytes=round(length / 1e6))
            return
        want(self.session, self.rig.id, sha256, length)

    def _at(self, item: ItemIn) -> str:
        return clean.label(item.at_utc, self.now_utc)

    def _person(self, code: str) -> CentreParticipant:
        return self._row(CentreParticipant, {"sessions": 0, "recordings": 0}, code=code, rig_id=self.rig.id)

    def _day(self, code: str, at_utc: str) -> CentreSession:
        """The session of a time."""
        day, person = local_day(at_utc), self._person(code)
        row = self._get(CentreSession, (code, day, self.rig.id))
        if row is None:
            row = CentreSession(participant=code, day=day, rig_id=self.rig.id, at_utc=at_utc, tests=0, recordings=0)
            self._add(row, (code, day, self.rig.id))
            person.sessions += 1
        row.at_utc = min(row.at_utc, at_utc)
        person.last_utc = max(person.last_utc or "", at_utc)
        return row

    def _day_of(self, model: CentreModel) -> CentreSession:
        """The session in which a model's recording was made."""
        recorded = self._recorded(model.recording_id) if model.recording_id else None
        return self._day(model.participant, recorded.created_utc if recorded else model.created_utc)

    def _stands(self, day: CentreSession, model: CentreModel) -> None:
        """This model stands for the session."""
        day.model_id, day.model_utc, day.verdict = model.id, model.created_utc, model.verdict
        person = self._person(model.participant)
        if day.at_utc[:10] >= (person.last_utc or "")[:10]:
            person.verdict = model.verdict

    def _recorded(self, recording_id: str) -> CentreRecording | None:
        key = (CentreRecording, (self.rig.id, recording_id))
        if key not in self._rows:
            query = select(CentreRecording).where(
                CentreRecording.rig_id == self.rig.id, CentreRecording.recording_id == recording_id
            )
            self._rows[key] = self.session.scalars(query).first()
        return self._rows[key]

    def _get(self, table: Any, key: tuple[Any, ...]) -> Any:
        if (table, key) not in self._rows:
            self._rows[table, key] = self.session.get(table, key)
        return self._rows[table, key]

    def _row(self, table: Any, more: Mapping[str, Any] = {}, **key: Any) -> Any:
        """The row of a key, whose columns are named in their order; one that is not there begins with `more`."""
        place = tuple(key.values())
        return self._get(table, place) or self._add(table(**key, **more), place)

    def _add(self, row: Any, key: tuple[Any, ...]) -> Any:
        self.session.add(row)
        self._rows[type(row), key] = row
        return row

    def _tell(self, kind: str, subject: str, **detail: Any) -> None:
        warnings.tell(self.session, self.now_utc, self.rig.id, kind, subject, **detail)


def want(session: Session, rig_id: int, sha256: str, length: int) -> None:
    """Ask a rig for a file, if it is not asked already."""
    asked = select(CentreWanted.id).where(CentreWanted.sha256 == sha256, CentreWanted.rig_id == rig_id)
    if session.scalars(asked.limit(1)).first() is None:
        session.add(CentreWanted(rig_id=rig_id, sha256=sha256, bytes=length))
        session.flush()
