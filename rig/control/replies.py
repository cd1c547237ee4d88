"""Requests and replies as lines of JSON, for both sockets."""

from __future__ import annotations

import contextlib
import json
import re
from typing import Any

from pydantic import BaseModel, ValidationError

from stimrig.rig.errors import RigError
from stimrig.rig.messages import Problem, Reply

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


def refusal(number: int, error: Exception) -> Reply:
    """Reply for a refusal of the rig, an invalid request (names the first place that is wrong), or a bug."""
    if isinstance(error, ValidationError):
        first: Any = error.errors(include_input=False, include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "request"
        problem = Problem(code="bad-plan", title="The request is wrong", detail=f"{place}: {first['msg']}")
    elif isinstance(error, RigError):
        problem = Problem(code=error.code, title=error.title, detail=str(error))
    else:
        problem = Problem(code=RigError.code, title=RigError.title, detail=f"{type(error).__name__}: {error}")
    return Reply(id=number, ok=False, problem=problem)


def to_line(message: BaseModel) -> bytes:
    return message.model_dump_json().encode() + b"\n"
