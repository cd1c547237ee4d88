"""Taking away for good what is kept of a participant, and files that are older than a rule lets them be.

Rows go in one transaction, in which an intent with the files' paths is written, too; the files go after it. Whatever
ends the process in between, the next run goes on with the files. The audit trail stays a chain: an entry about who is
erased keeps its number, time, person, action and hash, and loses what it said (`stimrig.api.store.audit`).
"""

from __future__ import annotations

import glob
import secrets
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import delete, func, or_, select
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock, utc_label
from stimrig.api.errors import ApiError, require_found
from stimrig.api.store import Store, audit, migrations, seen
from stimrig.api.store.tables import (
    OPEN_STATES,
    Analysis,
    Approval,
    AuditEntry,
    Erasure,
    Model,
    Note,
    Participant,
    Recording,
    Test,
    Token,
    Tracked,
)
from stimrig.api.whole_file import to_disk

DAY_S = 86_400.0
BY_RULE = "retention"


@dataclass(frozen=True)
class Kept:
    """What is kept of a participant: how many rows of each table, the files, and what still rests on them."""

    code: str
    counts: dict[str, int]
    files: list[str]
    in_use: str  # why a controller may still use it; empty: it does not
    last_utc: str  # when it was last tested or recorded, or made


class Eraser:
    """Looks at what is kept, and takes it away.

    `folders`: the rig's data folders, in which the recordings and journals of its tests lie, too.
    """

    def __init__(self, store: Store, clock: Clock, folders: Iterable[Path]) -> None:
        self.store, self.clock, self.folders = store, clock, list(folders)

    # ---- a participant

    def kept(self, code: str) -> Kept:
        """What would be taken away. Raises ApiError: 404 there is no such participant."""
        with self.store.read() as session:
            return self._kept(session, code)

    def _kept(self, session: Session, code: str) -> Kept:
        row = require_found(session.get(Participant, code), "participant", code, "GET /v1/participants lists them.")
        counts = {}
        for table, condition in _rows_of(session, code):
            counts[table.__tablename__] = session.scalar(select(func.count()).select_from(table).where(condition)) or 0
        tested = session.scalar(select(func.max(Test.requested_utc)).where(Test.participant == code))
        recorded = session.scalar(select(func.max(Recording.created_utc)).where(Recording.participant == code))
        last = max(filter(None, (row.created_utc, tested, recorded)))  # an upload is no test, and counts as one
        return Kept(code, counts, self._files(session, code), self._in_use(session, code), last)

    def _in_use(self, session: Session, code: str) -> str:
        now = self.clock.utc()
        holds = or_(Approval.expires_utc.is_(None), Approval.expires_utc > now)
        newest = select(Approval).where(Approval.participant == code, holds).order_by(Approval.id.desc()).limit(1)
        found = session.scalars(newest).first()
        if found is not None and found.approved:
            return f"model {found.model_id} is approved until {found.expires_utc or 'it is rejected'}"
        key = (
            Token.participant == code,
            Token.revoked.is_(False),
            or_(Token.expires_utc.is_(None), Token.expires_utc > now),
        )
        return "a controller's key is valid" if session.scalars(select(Token).where(*key).limit(1)).first() else ""

    def _files(self, session: Session, code: str) -> list[str]:
        """Recordings that rows name, and what the rig has of the participant's tests."""
        named = session.scalars(select(Recording.path).where(Recording.participant == code, Recording.path != ""))
        found = set(named)
        for test_id in session.scalars(select(Test.id).where(Test.participant == code)):
            name = glob.escape(test_id)
            for folder in self.folders:
                for pattern in (f"recordings/*Z_{name}.*", f"journals/{name}.*"):
                    found |= {str(path) for path in folder.glob(pattern)}
        return sorted(found | {place for path in found for place in self._elsewhere(path)} | self._copies())

    def _copies(self) -> set[str]:
        """Of the database as it was before an upgrade: they hold everybody."""
        database = self.store.engine.url.database
        folder = Path(database or "").parent / migrations.BEFORE
        return {str(path) for path in folder.glob("*")} if database and not self.store.several else set()

    def _elsewhere(self, path: str) -> Iterator[str]:
        """Other places of a file: the rig's own (the service sees a bind mount), or where it was restored to."""
        for folder in self.folders:
            yield from map(str, (folder / "recordings").rglob(glob.escape(Path(path).name)))

    def _refuse_outside(self, files: Iterable[str]) -> None:
        """Raises ApiError: 409 one is not below the data folders. The database alone removes nothing else."""
        known = [folder.resolve() for folder in self.folders]
        for path in map(Path, files):
            there = path.parent.resolve()
            if path.exists() and not any(there == one or one in there.parents for one in known):
                detail = f"{path}: it is in none of the data folders. Give its own with --rig-data, or move it there."
                raise ApiError(409, "outside", "A file is somewhere else", detail)

    def erase(self, code: str, reason: str, by: str, though_in_use: bool = False) -> tuple[str, Kept]:
        """Take a participant away; the erasure's number, and what was there.

        Raises ApiError: 404 no such participant; 409 a test goes on, or a controller may still use its model.
        """
        with self.store.write() as session:
            refuse_while_playing(session)
            kept = self._kept(session, code)
            if kept.in_use and not though_in_use:
                detail = f"{code}: {kept.in_use}. Reject the model and revoke the key, or say --though-in-use."
                raise ApiError(409, "in-use", "A controller may use it", detail)
            number = self._intend(session, code, reason, by, kept.files)
            names = _names(session, code)
            for table, condition in _rows_of(session, code):
                session.execute(delete(table).where(condition))
            self._blank(session, names, number, reason, by, kept.counts)
        self.finish()
        self._compact()
        return number, kept

    def _blank(
        self, session: Session, names: set[str], number: str, reason: str, by: str, counts: dict[str, int]
    ) -> None:
        """What the trail says of it, but for who did what when; the entry that says so vouches for the rest."""
        entries = session.scalars(select(AuditEntry).order_by(AuditEntry.seq)).all()
        newest = seen.last(session)
        of = newest.seq + 1 if newest else 1
        blanked = [
            entry for entry in entries
            if entry.action != audit.ERASE  # it names nobody, and vouches for what was blanked before
            and (entry.subject in names - {"page", "rig"} or _mentions(entry.detail, names))
        ]  # fmt: skip
        for entry in blanked:
            entry.subject, entry.detail = audit.ERASED, {"erased": of}
            if names & {entry.who, *entry.who.split(" ")}:  # what a test does by itself goes by its id
                entry.who = audit.ERASED
        session.flush()
        told = {"reason": reason, "rows": counts, "entries": len(blanked), "kept": audit.left_of(blanked)}
        audit.write(session, self.clock.utc(), by, audit.ERASE, number, **told)

    # ---- files by their age

    def old_recordings(self, days: float, but: Iterable[str] = ()) -> list[Recording]:
        """Recordings of before so many days whose files are still kept."""
        before = utc_label(self.clock.unix_s() - days * DAY_S)
        held = (Recording.created_utc < before, Recording.path != "", Recording.participant.not_in(list(but)))
        return self.store.all(Recording, *held, order=Recording.created_utc)

    def old_participants(self, days: float, but: Iterable[str] = ()) -> list[Kept]:
        """Participants of whom nothing was recorded for so many days, and whom no controller uses."""
        before = utc_label(self.clock.unix_s() - days * DAY_S)
        codes = self.store.all(Participant.code, Participant.code.not_in(list(but)), order=Participant.code)
        return [one for one in map(self.kept, codes) if one.last_utc < before and not one.in_use]

    def remove_files(self, rows: list[Recording], reason: str, by: str) -> str | None:
        """The files of these recordings; the rows stay, with hash and time. Raises ApiError: 409 a test goes on."""
        if not rows:
            return None
        with self.store.write() as session:
            refuse_while_playing(session)
            found = [session.get(Recording, row.id) for row in rows]
            paths = {row.path for row in found if row is not None and row.path}
            paths |= {place for path in paths for place in self._elsewhere(path)}
            number = self._intend(session, BY_RULE, reason, by, sorted(paths))
            for row in found:
                if row is not None:
                    row.path = ""
            hashes = {row.id: row.file_sha256 for row in found if row is not None}
            audit.write(session, self.clock.utc(), by, "delete recordings", number, reason=reason, sha256=hashes)
        self.finish()
        return number

    # ---- the intent, and its end

    def _intend(self, session: Session, of: str, reason: str, by: str, files: list[str]) -> str:
        self._refuse_outside(files)
        row = Erasure(id=secrets.token_hex(6), of=of, reason=reason, asked_by=by, asked_utc=self.clock.utc())
        row.files = files
        session.add(row)
        return row.id

    def waiting(self) -> list[Erasure]:
        """What was begun and is not done: its files may still be there."""
        return self.store.all(Erasure, Erasure.done_utc.is_(None), order=Erasure.asked_utc)

    def finish(self) -> None:
        """Remove the files of what was begun. Raises ApiError: 503 one cannot be removed; the next run goes on."""
        for row in self.waiting():
            self._refuse_outside(row.files)
            for path in row.files:
                _remove(Path(path))
            with self.store.write() as session:
                done = session.get(Erasure, row.id)
                if done is not None:  # the code goes with the last file
                    done.files, done.of, done.done_utc = [], audit.ERASED, self.clock.utc()

    def _compact(self) -> None:
        """SQLite leaves what was deleted in its file until it is written anew; PostgreSQL's autovacuum does that."""
        if not self.store.several:
            with self.store.engine.connect() as connection:
                raw = connection.connection.driver_connection
                assert raw is not None
                for statement in ("VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"):
                    raw.execute(statement)


def refuse_while_playing(session: Session) -> None:
    """Raises ApiError: 409 a test goes on, whoever's it is: nothing is read or deleted beside it."""
    going = session.scalars(select(Test).where(Test.state.in_(OPEN_STATES)).limit(1)).first()
    if going is not None:
        detail = (
            f"Test {going.id} is {going.state}. Wait for its end; where it has none, start the service: it ends it."
        )
        raise ApiError(409, "test-goes-on", "A test goes on", detail)


def _rows_of(session: Session, code: str) -> list[tuple[Any, Any]]:
    """Tables and which of their rows are a participant's, those first that name others."""
    recordings = list(session.scalars(select(Recording.id).where(Recording.participant == code)))
    of_models = or_(Model.participant == code, Model.recording_id.in_(recordings))
    models = list(session.scalars(select(Model.id).where(of_models)))
    return [
        (Analysis, Analysis.model_id.in_(models)),
        (Tracked, or_(Tracked.participant == code, Tracked.model_id.in_(models))),
        (Approval, or_(Approval.participant == code, Approval.model_id.in_(models))), (Note, Note.participant == code),
        (Model, of_models), (Recording, Recording.participant == code),
        (Test, Test.participant == code), (Token, Token.participant == code), (Participant, Participant.code == code),
    ]  # fmt: skip


def _names(session: Session, code: str) -> set[str]:
    """All by which the trail may call the participant, or what was theirs."""
    found = {code}
    for table, condition in _rows_of(session, code):
        if hasattr(table, "id"):
            found |= {str(key) for key in session.scalars(select(table.id).where(condition)) if isinstance(key, str)}
    return found


def _mentions(detail: Any, names: set[str]) -> bool:
    """Whether it names one of these, at whatever depth."""
    if isinstance(detail, dict):
        return any(_mentions(part, names) for pair in detail.items() for part in pair)
    if isinstance(detail, list):
        return any(_mentions(part, names) for part in detail)
    return isinstance(detail, str) and detail in names


def _remove(path: Path) -> None:
    """Down to the disk: what was said to be gone does not come back with the power."""
    try:
        path.unlink(missing_ok=True)
        if path.parent.is_dir():
            to_disk(path.parent)
    except OSError as error:
        detail = f"{path}: {error.strerror}. Run it as a user who may remove it; what was begun is gone on with then."
        raise ApiError(503, "file-stays", "A file could not be removed", detail) from error
