"""Hears what the store's sessions change, and writes it into the outbox in the same transaction."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

from sqlalchemy import inspect
from sqlalchemy.orm import Session, SessionTransaction

from api.clock import Clock
from api.outbox import chain, items
from api.outbox.chain import Telling
from api.store import Store
from api.store.tables import AuditEntry, Table

CHANGED = "changed-for-outbox"
UNTELLABLE = (ValueError, TypeError, AttributeError, RecursionError)
log = logging.getLogger("stimrig.outbox")


class Feed:
    """Listens to a store from now on.

    Rows and items stand or fall together: what is rolled back is not told. Nothing in the service changes the tables
    that are told of by SQL past its sessions' objects; what is changed elsewhere `api.outbox.reconcile` finds.
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
