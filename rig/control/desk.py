"""What the rig does for each request, and its reply. Knows no socket."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from typing import Any

from pydantic import BaseModel, TypeAdapter

from stimrig.rig.control.replies import internal_error, refusal
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import RigError
from stimrig.rig.messages import Reply, Request

log = logging.getLogger("rig.desk")

_REQUEST: TypeAdapter[Any] = TypeAdapter(Request)

_DO: dict[str, Callable[[Rig, Any], Awaitable[BaseModel | None]]] = {
    "start": lambda rig, asked: rig.start(asked.plan, asked.key),
    "stop": lambda rig, asked: rig.stop(asked.reason, asked.by),
    "withdraw": lambda rig, asked: rig.player.withdraw(asked),
    "extend": lambda rig, asked: rig.player.extend(asked),
    "enough": lambda rig, asked: rig.player.enough(asked),
    "sequences": lambda rig, _: rig.library(),
    "rearm": lambda rig, asked: rig.rearm(asked.by, asked.latch),
    "calibrate-start": lambda rig, asked: rig.calibrations.start(asked),
    "calibrate-step": lambda rig, asked: rig.calibrations.step(asked),
    "calibrate-mark": lambda rig, asked: rig.calibrations.mark(asked),
    "calibrate-finish": lambda rig, asked: rig.calibrations.finish(asked),
    "calibrate-stored": lambda rig, asked: rig.calibrations.stored(asked.calibration_id),
    "angle_pose": Rig.angle_pose,
}
"""What has no answer of its own, and all others, are answered by the status."""


def read(line: bytes) -> Any:
    return _REQUEST.validate_json(line)


async def obey(rig: Rig, request: Any) -> Reply:
    """Obey a request; errors become part of the reply."""
    try:
        do = _DO.get(request.kind)
        answer = None if do is None else await do(rig, request)
        body = (rig.status() if answer is None else answer).model_dump(mode="json")
    except RigError as error:
        return refusal(request.id, error)
    except Exception as error:
        log.exception("request %s failed", request.kind)
        return internal_error(request.id, error)
    return Reply(id=request.id, ok=True, body=body)
