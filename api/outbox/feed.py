"""What a centre is told of a row, and when: what the store's sessions change, in the same transaction; the rest later.

What a person typed freely stays at the rig: notes, and the reason of a decision. So do paths. The audit trail stays,
too; the centre gets the hash of each entry, by which it can be told later whether the trail was changed. The rest is
whatever row's content is not its newest item, from before a centre was configured, or from past the feed.
"""

from __future__ import annotations

import heapq
import json
import logging
import math
import re
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from sqlalchemy import func, inspect, select, tuple_
from sqlalchemy.orm import Session, SessionTransaction

from stimrig.api.clock import Clock
from stimrig.api.outbox import chain
from stimrig.api.outbox.chain import Telling
from stimrig.api.store import Store, uploads
from stimrig.api.store.audit import canonical
from stimrig.api.store.tables import (
    OPEN_STATES,
    Approval,
    AuditEntry,
    Model,
    Participant,
    Recording,
    Table,
    Test,
    Tracked,
)

CHANGED = "changed-for-outbox"
UNTELLABLE = (ValueError, TypeError, AttributeError, RecursionError)
BATCH = 50
PAGE = 1000
LONGEST_BODY = 500_000
LONGEST_LIST = 100
DEEPEST = 20
OF_TEST = (
    "id", "participant", "kind", "state", "reason", "summary", "recording_id", "model_id", "requested_by",
    "requested_utc", "finished_utc", "ran_by",
)  # fmt: skip
OF_PLAN = (
    "test_id", "profile", "segments", "protocol", "pulse_rate_hz", "max_pulse_width_us", "max_torque_nm", "adaptive",
    "angle", "preview", "joins", "side", "muscle", "tokens", "target", "reach", "bounds", "joint", "approval_id",
    "reference_torque_nm", "participant", "kind", "channels",
)  # fmt: skip
"""What a centre is told of a test, and of its plan. Nothing else leaves: a new column or label only once it is here."""
SHA256 = re.compile(r"[0-9a-f]{64}")
TABLES: dict[type[Table], tuple[Any, Any]] = {
    Participant: (Participant.created_utc, Participant.code),
    Recording: (Recording.created_utc, Recording.id),
    Model: (Model.created_utc, Model.id),
    Test: (func.coalesce(Test.finished_utc, Test.requested_utc), Test.id),
    Approval: (Approval.at_utc, Approval.id),
    Tracked: (Tracked.at_utc, Tracked.test_id),
    AuditEntry: (AuditEntry.at_utc, AuditEntry.seq),
}
"""What is told of, in the order in which one transaction's rows are told: when a row came about, and its key."""
log = logging.getLogger("stimrig.outbox")


class Feed:
    """Listens to a store from now on.

    Rows and items stand or fall together: what is rolled back is not told. Nothing in the service changes the tables
    that are told of by SQL past its sessions' objects; what is changed elsewhere `batches` finds.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self.clock = clock
        store.listen("after_flush", self._gather)
        store.listen("before_commit", self._write)
        store.listen("after_soft_rollback", self._forget)

    def _gather(self, session: Session, _flush: object) -> None:
        changed: dict[int, Table] = session.info.setdefault(CHANGED, {})
        for row in (*session.new, *(row for row in session.dirty if session.is_modified(row))):
            if type(row) in TABLES:
                changed[id(row)] = row

    def _write(self, session: Session) -> None:
        if session.in_nested_transaction():  # it may still be rolled back by itself
            return
        session.flush()
        rows = [row for row in session.info.pop(CHANGED, {}).values() if inspect(row).persistent]
        if rows:
            chain.put(session, self.clock.utc(), tellings(rows))

    def _forget(self, session: Session, ended: SessionTransaction) -> None:
        if not ended.nested:
            session.info.pop(CHANGED, None)


def tellings(rows: Iterable[Table]) -> Iterator[Telling]:
    """What is told of a transaction's rows."""
    order = list(TABLES)
    for row in sorted(rows, key=lambda row: (order.index(type(row)), row.seq if isinstance(row, AuditEntry) else 0)):
        try:
            found = telling(row)
        except UNTELLABLE:  # a row that cannot be told keeps nobody from working
            log.exception("a row of %s could not be told to the centre", row.__tablename__)
            continue
        if found is not None:
            yield found


def batches(store: Store, clock: Clock) -> Iterator[int]:
    """Put in what is missing, in order of time; after each batch of rows how many items were put in.

    Nothing is held open in between: neither a transaction nor more than a page of keys for each table.
    """
    rows = heapq.merge(*(_keys(store, table, rank) for rank, table in enumerate(TABLES)))
    while batch := list(islice(rows, BATCH)):
        yield _put(store, clock, [(list(TABLES)[rank], key) for _at, rank, key in batch])


def _keys(store: Store, table: type[Table], rank: int) -> Iterator[tuple[str, int, Any]]:
    """Time, rank and key of a table's rows, in order of time; read page by page."""
    at, key = TABLES[table]
    after: tuple[Any, Any] | None = None
    while True:
        query = select(at, key).order_by(at, key).limit(PAGE)
        if after is not None:
            query = query.where(tuple_(at, key) > tuple_(*after))
        with store.read() as session:
            page = [tuple(row) for row in session.execute(query)]
        for when, one in page:
            yield str(when), rank, one
        if len(page) < PAGE:
            return
        after = page[-1]


def _put(store: Store, clock: Clock, keys: list[tuple[type[Table], Any]]) -> int:
    """Put in those whose newest item says something else; looked at first without keeping others from writing."""
    with store.read() as session:
        changed = {(each.kind, each.key) for each in chain.unlike_newest(session, _read(session, keys))}
    if not changed:
        return 0
    with store.write() as session:
        new = [each for each in _read(session, keys) if (each.kind, each.key) in changed]
        return chain.put(session, clock.utc(), new)


def _read(session: Session, keys: list[tuple[type[Table], Any]]) -> list[Telling]:
    """What is told of these rows, in this order."""
    found: dict[tuple[type[Table], Any], Table] = {}
    for table in {table for table, _ in keys}:
        column = inspect(table).primary_key[0]
        for row in session.scalars(select(table).where(column.in_([key for of, key in keys if of is table]))):
            found[table, getattr(row, str(column.key))] = row
    return [telling for of in keys if of in found for telling in tellings([found[of]])]


def telling(row: Table) -> Telling | None:
    """What is told of a row; None where nothing is: a test that goes on."""
    if isinstance(row, Test):
        return None if row.state in OPEN_STATES else Telling("test", row.id, _bounded(_test(row)))
    if isinstance(row, Recording):
        return _recording(row)
    if isinstance(row, Model | Tracked):
        return _add_document(row)
    if isinstance(row, AuditEntry):
        body = {"seq": row.seq, "hash": row.hash, "previous_hash": row.previous_hash, "at_utc": row.at_utc}
        return Telling("audit", str(row.seq), body)
    if isinstance(row, Approval):
        return Telling("decision", str(row.id), _bounded(_without(row, "reason", "site", "undone")))
    if isinstance(row, Participant):
        return Telling("participant", row.code, _bounded(_without(row, "placement")))
    return None


def _test(row: Test) -> dict[str, Any]:
    plan = {name: value for name, value in (row.plan or {}).items() if name in OF_PLAN}
    if isinstance(preview := plan.get("preview"), dict):
        plan["preview"] = {name: value for name, value in preview.items() if not isinstance(value, list | dict)}
    return {**{name: getattr(row, name) for name in OF_TEST}, "plan": plan}


def _recording(row: Recording) -> Telling:
    body = _bounded({**_without(row, "path", "site"), "name": Path(row.path).name})
    if not row.path or not SHA256.fullmatch(row.file_sha256):  # no path: a rule took the file
        return Telling("recording", row.id, body)
    return Telling("recording", row.id, body, row.file_sha256, length_of(Path(row.path)))


def length_of(path: Path) -> int | None:
    """A file's length; an upload's is in a folder of its own until its row is written. None: it is not there."""
    for place in (path, uploads.part_of(path)):
        try:
            return place.stat().st_size
        except OSError:
            continue
    return None


def _add_document(row: Model | Tracked) -> Telling:
    kind, key = ("model", row.id) if isinstance(row, Model) else ("tracked", row.test_id)
    body = _bounded(_without(row, "document"))
    if row.document is None or row.etag is None or not SHA256.fullmatch(row.etag):
        return Telling(kind, key, body)
    return Telling(kind, key, body, row.etag, len(row.document))


def _without(row: Table, *columns: str) -> dict[str, Any]:
    return {name: value for name, value in row.as_dict().items() if name not in columns}


def _bounded(body: dict[str, Any]) -> dict[str, Any]:
    """The body as JSON knows it, and not longer than fits well into a batch."""
    plain: dict[str, Any] = _plain(json.loads(json.dumps(body)))
    if len(canonical(plain)) <= LONGEST_BODY:
        return plain
    plain = {name: _shortened(value) for name, value in plain.items()}
    if len(canonical(plain)) <= LONGEST_BODY:
        return plain
    return {name: value for name, value in plain.items() if not isinstance(value, dict | list)}


def _plain(value: Any, depth: int = 0) -> Any:
    """Without what JSON or UTF-8 cannot hold, a number that is none is null; and not nested without end."""
    if isinstance(value, dict | list) and depth >= DEEPEST:
        return {"left_out": len(value)}
    if isinstance(value, dict):
        return {_plain(name): _plain(each, depth + 1) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each, depth + 1) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


def _shortened(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _shortened(each) for name, each in value.items()}
    if isinstance(value, list):
        return {"left_out": len(value)} if len(value) > LONGEST_LIST else [_shortened(each) for each in value]
    return value
