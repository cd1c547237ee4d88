"""What the store's sessions change goes into the outbox in the same transaction; the rest is put in later.

The rest: whatever row's content is not its newest item, from before a centre was configured, or from past the feed.
"""

from __future__ import annotations

import heapq
import logging
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

from sqlalchemy import func, inspect, select, tuple_
from sqlalchemy.orm import Session, SessionTransaction

from stimrig.api.clock import Clock
from stimrig.api.outbox import chain, items
from stimrig.api.outbox.chain import Telling
from stimrig.api.store import Store
from stimrig.api.store.tables import Approval, AuditEntry, Model, Participant, Recording, Table, Test, Tracked

CHANGED = "changed-for-outbox"
UNTELLABLE = (ValueError, TypeError, AttributeError, RecursionError)
BATCH = 50
PAGE = 1000
TIMES: dict[type[Table], tuple[Any, Any]] = {
    Participant: (Participant.created_utc, Participant.code),
    Recording: (Recording.created_utc, Recording.id),
    Model: (Model.created_utc, Model.id),
    Test: (func.coalesce(Test.finished_utc, Test.requested_utc), Test.id),
    Approval: (Approval.at_utc, Approval.id),
    Tracked: (Tracked.at_utc, Tracked.test_id),
    AuditEntry: (AuditEntry.at_utc, AuditEntry.seq),
}
"""When a row came about, and its key."""
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
            if type(row) in items.TABLES:
                changed[id(row)] = row

    def _write(self, session: Session) -> None:
        if session.in_nested_transaction():  # it may still be rolled back by itself
            return
        session.flush()
        rows = [row for row in session.info.pop(CHANGED, {}).values() if inspect(row).persistent]
        if rows:
            chain.put(session, self.clock.utc(), told(rows))

    def _forget(self, session: Session, ended: SessionTransaction) -> None:
        if not ended.nested:
            session.info.pop(CHANGED, None)


def told(rows: Iterable[Table]) -> Iterator[Telling]:
    """What is told of a transaction's rows."""
    order = list(items.TABLES)
    for row in sorted(rows, key=lambda row: (order.index(type(row)), row.seq if isinstance(row, AuditEntry) else 0)):
        try:
            telling = items.telling(row)
        except UNTELLABLE:  # a row that cannot be told keeps nobody from working
            log.exception("a row of %s could not be told to the centre", row.__tablename__)
            continue
        if telling is not None:
            yield telling


def batches(store: Store, clock: Clock) -> Iterator[int]:
    """Put in what is missing, in order of time; after each batch of rows how many items were put in.

    Nothing is held open in between: neither a transaction nor more than a page of keys for each table.
    """
    rows = heapq.merge(*(_keys(store, table, rank) for rank, table in enumerate(TIMES)))
    while batch := list(islice(rows, BATCH)):
        yield _put(store, clock, [(list(TIMES)[rank], key) for _at, rank, key in batch])


def _keys(store: Store, table: type[Table], rank: int) -> Iterator[tuple[str, int, Any]]:
    """Time, rank and key of a table's rows, in order of time; read page by page."""
    at, key = TIMES[table]
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
        changed = {(each.kind, each.key) for each in chain.unlike_newest(session, _tellings(session, keys))}
    if not changed:
        return 0
    with store.write() as session:
        tellings = [each for each in _tellings(session, keys) if (each.kind, each.key) in changed]
        return chain.put(session, clock.utc(), tellings)


def _tellings(session: Session, keys: list[tuple[type[Table], Any]]) -> list[Telling]:
    """What is told of these rows, in this order."""
    found: dict[tuple[type[Table], Any], Table] = {}
    for table in {table for table, _ in keys}:
        column = inspect(table).primary_key[0]
        for row in session.scalars(select(table).where(column.in_([key for of, key in keys if of is table]))):
            found[table, getattr(row, str(column.key))] = row
    return [telling for of in keys if of in found for telling in told([found[of]])]
