"""Requests and replies as lines of JSON, for both sockets and the preview builder."""

from __future__ import annotations

import contextlib
import json
import re
import time
from typing import Any, BinaryIO

from pydantic import BaseModel, ValidationError

from stimrig.rig import limits, plan
from stimrig.rig.control.calibration import check_profile, check_range
from stimrig.rig.errors import RigError
from stimrig.rig.limits import Limit
from stimrig.rig.messages import Preview, Problem, Reply
from stimrig.rig.requests import PreviewRequest

_HEAD = re.compile(rb'\s*\{\s*"kind"\s*:\s*"([a-z_-]{1,40})"\s*,\s*"id"\s*:\s*(\d{1,15})\s*[,}]')


def head_of(line: bytes) -> tuple[str, int] | None:
    """Kind and id of a request that begins with them, as `stimrig.rig.messages` writes it, without parsing the rest."""
    match = _HEAD.match(line[:200])
    return (match[1].decode(), int(match[2])) if match else None


def id_of(line: bytes) -> int:
    """The id of an invalid request; 0 if it has none."""
    if (head := head_of(line)) is not None:
        return head[1]
    with contextlib.suppress(ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        return int(json.loads(line).get("id", 0))
    return 0


def refusal(number: int, error: RigError) -> Reply:
    """Reply for an exception of the rig."""
    return Reply(id=number, ok=False, problem=Problem(code=error.code, title=error.title, detail=str(error)))


def internal_error(number: int, error: Exception) -> Reply:
    """Reply for a bug in this program."""
    detail = f"{type(error).__name__}: {error}"
    return Reply(id=number, ok=False, problem=Problem(code=RigError.code, title=RigError.title, detail=detail))


def invalid_request(number: int, error: ValidationError) -> Reply:
    """Reply for an invalid request: names the first place that is wrong."""
    first: Any = error.errors(include_input=False, include_url=False)[0]
    place = ".".join(str(part) for part in first["loc"]) or "request"
    detail = f"{place}: {first['msg']}"
    return Reply(id=number, ok=False, problem=Problem(code="bad-plan", title="The request is wrong", detail=detail))


def to_line(message: BaseModel) -> bytes:
    return message.model_dump_json().encode() + b"\n"


def previewed(
    request: PreviewRequest,
    table: dict[str, Limit],
    unix_s: float,
    speed: float = 1.0,
    angle_set_at_utc: str | None = None,
) -> Preview:
    """Duration, dose and pulses of a plan. Raises PlanError, RefusedError."""
    check_range(request.plan, angle_set_at_utc)
    test = plan.build(request.plan, limits.for_plan(table, request.plan))
    check_profile(request.plan.profile, unix_s, required=False, duration_s=test.longest_s / speed)
    return plan.preview(test, request.recruitment)


def answer(line: bytes, table: dict[str, Limit], unix_s: float, speed: float, angle_set_at_utc: str | None) -> Reply:
    try:
        request = PreviewRequest.model_validate_json(line)
        body = previewed(request, table, unix_s, speed, angle_set_at_utc).model_dump(mode="json")
        return Reply(id=request.id, ok=True, body=body)
    except ValidationError as error:
        return invalid_request(id_of(line), error)
    except RigError as error:
        return refusal(id_of(line), error)
    except Exception as error:
        return internal_error(id_of(line), error)


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Read the rig's limits from the first line, then answer requests until the end of input.

    Before each request stands a line with the angle sensor's `set_at_utc`, which changes while the rig runs.
    """
    first = requests.readline()
    if not first:
        return
    settings = json.loads(first)
    table = {name: Limit(**row) for name, row in settings["table"].items()}
    for of_angle in requests:
        reply = answer(requests.readline(), table, time.time(), settings["speed"], json.loads(of_angle))
        replies.write(to_line(reply))
        replies.flush()
