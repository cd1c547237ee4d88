"""Notes on a participant's session or on a test."""

from __future__ import annotations

import asyncio

from stimrig.api.services.context import Context
from stimrig.api.sessions.requests import NoteIn
from stimrig.api.store.tables import Note


async def add(context: Context, code: str, body: NoteIn, by: str) -> Note:
    """Write a note; one that is made `now` stands at the time at which its test is."""
    position = context.runner.hub.position(body.test_id) if body.test_id else None
    now_s = position[0] if position and context.runner.plays(body.test_id) else None
    return await asyncio.to_thread(context.notes.add, code, body, by, now_s)
