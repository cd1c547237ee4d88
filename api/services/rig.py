"""The rig: its state, and re-arming it by a person."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.services.context import Context
from stimrig.api.store import locking
from stimrig.api.store.locking import Tags
from stimrig.rig.messages import Status
from stimrig.rig.requests import RearmRequest


def rig_state(context: Context) -> dict[str, Any]:
    """Return the rig's last status and its age."""
    status = context.rig.status
    current = context.runner.current
    return {
        "connected": context.rig.connected,
        "age_s": context.rig.age_s,
        **(
            status.model_dump(exclude={"finished"})
            if status
            else {"state": "disconnected", "reason": "the rig has not spoken yet"}
        ),
        "holder": current.holder if current else None,
    }


async def rearm(context: Context, by: str, tags: Tags) -> Status:
    """Re-arm the rig after the stop that was shown. Raises ApiError: 412 it was stopped again since."""
    latch, latches = tags[0], context.rig.latches
    _, shown_reason = latches.get(latch, ("", ""))
    note = partial(context.store.note, context.clock, by)
    await asyncio.to_thread(note, "re-arm", "rig", reason=shown_reason)
    try:
        await context.rig.ask(RearmRequest(by=by, latch=latch))
    except ApiError as error:
        await asyncio.to_thread(note, "re-arm refused", "rig", why=error.detail)
        if error.code != "rig-latch-changed":
            raise
        status = await context.rig.fresh_status()
        at_utc, reason = latches[status.latch]
        change = {
            "who": "",
            "at_utc": at_utc,
            "action": "latched",
            "subject": "rig",
            "old": shown_reason,
            "new": reason,
        }
        raise locking.ChangedError(status.latch, [change], error.detail) from error
    return await context.rig.fresh_status()
