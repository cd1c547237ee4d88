"""Who may stop: whoever holds a page's right to stop, or is signed in."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Annotated

from fastapi import Request, Security
from fastapi.security import APIKeyHeader
from pydantic import ValidationError
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from stimrig.api.errors import ApiError, not_answering
from stimrig.api.sessions.requests import StopIn
from stimrig.api.web.guards import Session, Token

FIELD, HEADER = "right", "x-stop-right"
PATIENCE_S, LONGEST_PATIENCE_S = 0.5, 3.0
"""A stop waits so long for its body; and so long where nothing but a right in it would allow the stop."""
DEFAULT_REASON = "stop pressed"
RIGHT = APIKeyHeader(name="X-Stop-Right", scheme_name="right", auto_error=False, description="a page's right to stop")
Right = Annotated[object, Security(RIGHT)]


@dataclass(frozen=True)
class Press:
    """A stop that is allowed: who pressed it, and why; a controller's key is told of no other participant."""

    by: str
    reason: str
    by_key: bool = False


async def anyone_who_may_stop(request: Request, _token: Token, _session: Session, _right: Right) -> Press:
    """A dependency for stop: who holds a page's right, or is signed in, be it that the session or token ran out.

    The right is looked at first: it needs no database, and nothing that holds back guesses holds it back.
    """
    coming = asyncio.create_task(_sent(request))
    try:
        reason, by = await _within(PATIENCE_S, request, coming)
        if by is not None:
            return Press(by, reason)
        try:
            return await _signed_in(request, reason)
        except ApiError as error:
            reason, by = await _within(LONGEST_PATIENCE_S - PATIENCE_S, request, coming)
            if by is not None:
                return Press(by, reason)
            error.title = "Nothing was stopped"
            error.detail = f"Use the emergency switch on the stimulator now, or sign in and press Stop. {error.detail}"
            raise
    finally:
        coming.cancel()


async def _signed_in(request: Request, reason: str) -> Press:
    """Who is signed in; where the database does not say so at once, who was when it last did. Raises ApiError."""
    auth = request.app.state.context.auth
    try:
        who = await auth.ask_within(request, PATIENCE_S, forgive_age=True, bound=True)
        return Press(who.name, reason, who.participant is not None)
    except (TimeoutError, SQLAlchemyError):
        if (name := auth.seen(request)) is not None:
            return Press(name, reason, by_key=True)  # whether a key asks is not known: then nobody else is named
        raise not_answering() from None


async def _within(patience_s: float, request: Request, coming: asyncio.Task[tuple[str, str]]) -> tuple[str, str | None]:
    """The reason, and whose right to stop was sent, as far as they have come in this time."""
    await asyncio.wait([coming], timeout=patience_s)
    reason, in_form = coming.result() if coming.done() else (DEFAULT_REASON, "")
    context, right = request.app.state.context, request.headers.get(HEADER) or in_form
    current, status = context.runner.current, context.rig.status
    running = {current.test_id if current else None, status.test_id if status else None}
    by = context.stop_rights.holder(right, running)
    if by is not None:
        request.state.stop_right = right
    return reason, by


async def _sent(request: Request) -> tuple[str, str]:
    """The body's reason and right; whatever it holds, a stop is a stop."""
    try:
        if "form" in request.headers.get("content-type", ""):
            form = await request.form()
            return str(form.get("reason") or DEFAULT_REASON)[:200], str(form.get(FIELD) or "")
        body = await request.body()
        return StopIn.model_validate_json(body).reason if body.strip() else DEFAULT_REASON, ""
    except (ValidationError, ValueError, ApiError, HTTPException, ClientDisconnect):
        return DEFAULT_REASON, ""
