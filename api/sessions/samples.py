"""Every torque sample of a running test, on a connection of its own: the lasting one carries what pages draw."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator
from pathlib import Path

from stimrig.api.errors import ApiError
from stimrig.api.sessions.rig_client import LINE_LIMIT, no_rig
from stimrig.rig.messages import LiveEvent, SubscribeRequest


async def samples_of(path: Path | None, test_id: str) -> AsyncGenerator[LiveEvent, None]:
    """The live events of a test with all samples, until it has ended.

    Raises
    ------
    ApiError
        503: the rig cannot be reached, or the connection broke before the end.
    """
    try:
        reader, writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
    except OSError as error:
        raise no_rig(str(error)) from error
    try:
        writer.write(SubscribeRequest(samples=True).model_dump_json().encode() + b"\n")
        async for event in _events(reader):
            if event.get("test_id") == test_id:
                if event["event"] == "finished":
                    return
                yield LiveEvent.model_validate(event)
        raise no_rig("It closed the connection.")
    except (OSError, ValueError) as error:
        raise no_rig(str(error)) from error
    finally:
        writer.close()


async def _events(reader: asyncio.StreamReader) -> AsyncIterator[dict]:
    """Live and finished events; a refused subscription is an error."""
    while line := await reader.readline():
        message = json.loads(line)
        if message.get("event") in ("live", "finished"):
            yield message
        elif message.get("ok") is False:
            raise ApiError(503, "rig-unreachable", "The rig cannot be reached", "It tells nobody its samples.")
