"""Tests: finding them, and who ran one."""

from __future__ import annotations

from typing import Any

from stimrig.api.errors import require_found
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.sessions.playing import other_than
from stimrig.api.store import locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Test

LISTED = "GET /v1/tests lists them."


def find(context: Context, test_id: str) -> Test:
    """Return a test. Raises ApiError: 404 there is none of this id."""
    return require_found(context.store.get(Test, test_id), "test", test_id, LISTED)


def change_ran_by(context: Context, test_id: str, name: str | None, by: str, tags: Tags) -> Test:
    """Note who ran a test at the rig. Raises ApiError: 404 no such test; 412 it was changed since."""
    with context.store.write() as session:
        row: Test = require_found(session.get(Test, test_id), "test", test_id, LISTED)
        locking.check(session, row, tags)
        row.ran_by = other_than(row.requested_by, name)
        ran_by = row.ran_by or row.requested_by
        locking.write(session, row, context.clock.utc(), by, locking.RAN_BY, test_id, ran_by=ran_by)
    return row


def newest(context: Context, limit: int, participant: str | None = None) -> list[dict[str, Any]]:
    """List tests, the newest first. Raises NotFoundError: there is no such participant."""
    if participant is None:
        rows = context.store.all(Test, order=Test.requested_utc.desc(), limit=limit)
        return [context.runner.document(row) for row in rows]
    participants.find(context, participant)
    return context.runner.documents(participant, context.versions.of(participant), limit)
