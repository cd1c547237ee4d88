"""Tests: finding them."""

from __future__ import annotations

from typing import Any

from stimrig.api.errors import require_found
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.store.tables import Test

LISTED = "GET /v1/tests lists them."


def find(context: Context, test_id: str) -> Test:
    """Return a test. Raises ApiError: 404 there is none of this id."""
    return require_found(context.store.get(Test, test_id), "test", test_id, LISTED)


def newest(context: Context, limit: int, participant: str | None = None) -> list[dict[str, Any]]:
    """List tests, the newest first. Raises NotFoundError: there is no such participant."""
    if participant is None:
        rows = context.store.all(Test, order=Test.requested_utc.desc(), limit=limit)
        return [context.runner.document(row) for row in rows]
    participants.find(context, participant)
    return context.runner.documents(participant, context.versions.of(participant), limit)
