"""The rig: its state, and re-arming it by a person."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.services.context import Context
from stimrig.api.store.locking import ChangedError, Tags
from stimrig.rig.messages import Status
from stimrig.rig.requests import RearmRequest

NEVER_HEARD = Status.model_validate({"state": "disconnected", "reason": "the rig has not spoken yet"})


def rig_state(context: Context) -> dict[str, Any]:
    """Return the rig's last status and its age."""
    rig, current = context.rig, context.runner.current
    status = (rig.status or NEVER_HEARD).model_dump(exclude={"finished"})
    return {"connected": rig.connected, "age_s": rig.age_s, **status, "holder": current.holder if current else None}


async def rearm(context: Context, by: str, tags: Tags) -> Status:
    """Re-arm the rig after the stop that was shown. Raises ApiError: 412 it was stopped again since."""
    rig, latch = context.rig, tags[0]
    _, shown_reason = rig.latches.get(latch, ("", ""))
    note = partial(context.store.note, context.clock, by)
    await asyncio.to_thread(note, "re-arm", "rig", reason=shown_reason)
    try:
        await rig.ask(RearmRequest(by=by, latch=latch))
    except ApiError as error:
        await asyncio.to_thread(note, "re-arm refused", "rig", why=error.detail)
        if error.code != "rig-latch-changed":
            raise
        status = await rig.fresh_status()
        at_utc, reason = rig.latches[status.latch]
        change = {"who": "", "at_utc": at_utc, "action": "latched", "subject": "rig"}
        change |= {"old": shown_reason, "new": reason}
        raise ChangedError(status.latch, [change], error.detail) from error
    return await rig.fresh_status()
