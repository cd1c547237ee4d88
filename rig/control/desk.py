"""What the rig does for each request, and its reply. Knows no socket."""

from __future__ import annotations

import logging
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from rig.control.replies import id_of, internal_error, invalid_request, refusal
from rig.control.rig import Rig
from rig.errors import RigError
from rig.messages import Reply, Request

log = logging.getLogger("rig.desk")

_REQUEST: TypeAdapter[Any] = TypeAdapter(Request)


def read(line: bytes) -> Any:
    """The request of a line of JSON. Raises ValidationError."""
    return _REQUEST.validate_json(line)


async def answer(rig: Rig, line: bytes) -> Reply:
    """Obey a line of JSON."""
    try:
        request = read(line)
    except ValidationError as error:
        return invalid_request(id_of(line), error)
    return await obey(rig, request)


async def obey(rig: Rig, request: Any) -> Reply:
    """Obey a request; errors become part of the reply."""
    try:
        body = (await _do(rig, request)).model_dump(mode="json")
    except RigError as error:
        return refusal(request.id, error)
    except Exception as error:
        log.exception("request %s failed", request.kind)
        return internal_error(request.id, error)
    return Reply(id=request.id, ok=True, body=body)


async def _do(rig: Rig, request: Any) -> BaseModel:
    match request.kind:
        case "start":
            return await rig.start(request.plan, request.key)
        case "stop":
            return await rig.stop(request.reason, request.by)
        case "withdraw":
            return await rig.withdraw(request)
        case "extend":
            return await rig.extend(request)
        case "enough":
            return await rig.enough(request)
        case "sequences":
            return await rig.library()
        case "rearm":
            return await rig.rearm(request.by, request.latch)
        case "calibrate-start":
            return await rig.calibrate(request)
        case "calibrate-step":
            return await rig.calibrate_step(request.direction, request.shown_us)
        case "calibrate-mark":
            return await rig.calibrate_mark(request.threshold)
        case "calibrate-finish":
            return await rig.calibrate_finish(request)
        case "calibrate-stored":
            return await rig.calibrate_stored(request.calibration_id)
        case "angle_pose":
            return await rig.angle_pose(request)
        case _:
            return rig.status()
