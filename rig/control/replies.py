"""Requests and replies as lines of JSON: what the sockets and the builder of previews have in common."""

from __future__ import annotations

import contextlib
import json
import re
from typing import Any

from pydantic import BaseModel, ValidationError

from rig.errors import RigError
from rig.messages import Problem, Reply

_HEAD = re.compile(rb'\s*\{\s*"kind"\s*:\s*"([a-z-]{1,40})"\s*,\s*"id"\s*:\s*(\d{1,15})\s*[,}]')


def head_of(line: bytes) -> tuple[str, int] | None:
    """Kind and id where a request begins with them, as `rig.messages` writes it; read without parsing the rest."""
    found = _HEAD.match(line[:200])
    return (found[1].decode(), int(found[2])) if found else None


def id_of(line: bytes) -> int:
    """The id of a request that is no valid one; 0 where there is none."""
    if (head := head_of(line)) is not None:
        return head[1]
    with contextlib.suppress(ValueError, TypeError, AttributeError, RecursionError):
        return int(json.loads(line).get("id", 0))
    return 0


def refusal(number: int, error: RigError) -> Reply:
    """An exception as clients see it."""
    return Reply(id=number, ok=False, problem=Problem(code=error.code, title=error.title, detail=str(error)))


def unforeseen(number: int, error: Exception) -> Reply:
    """A mistake in this program as clients see it."""
    detail = f"{type(error).__name__}: {error}"
    return Reply(id=number, ok=False, problem=Problem(code=RigError.code, title=RigError.title, detail=detail))


def wrong(number: int, error: ValidationError) -> Reply:
    """A request that is none: the first place where it is wrong."""
    first: Any = error.errors(include_input=False, include_url=False)[0]
    place = ".".join(str(part) for part in first["loc"]) or "request"
    detail = f"{place}: {first['msg']}"
    return Reply(id=number, ok=False, problem=Problem(code="bad-plan", title="The request is wrong", detail=detail))


def to_line(message: BaseModel) -> bytes:
    """One line of JSON."""
    return message.model_dump_json().encode() + b"\n"
