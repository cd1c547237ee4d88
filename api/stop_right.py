"""The right to stop: whoever has the stop button in view may press it.

A page that shows the button carries a signed value in its form. It allows a stop and nothing else, and asks neither
the database nor a session: it outlives sign-out, the session's end, a new password and a revoked token.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import hmac
import json
from collections.abc import Collection
from dataclasses import dataclass

from fastapi import Request
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from api.clock import Clock
from api.errors import ApiError
from api.schemas import StopIn

FIELD, HEADER = "right", "x-stop-right"
RIGHT_S = 24 * 3600.0
"""A page's right holds this long, which no session exceeds, and beyond that while the test that it shows is running."""
LONGEST = 1000
PATIENCE_S, LONGEST_PATIENCE_S = 0.5, 3.0
"""A stop waits so long for its body; and so long where nothing but a right in it would allow the stop."""
DEFAULT_REASON = "stop pressed"


class StopRights:
    """Gives rights to stop and knows them again.

    Parameters
    ----------
    key : bytes
        The service's own; a restart keeps it, so that the pages that are open stay good.
    clock : Clock
        Their age is measured on it.
    """

    def __init__(self, key: bytes, clock: Clock) -> None:
        self._key, self.clock = key, clock

    def give(self, name: str, test_id: str | None) -> str:
        """A right for the page of `name`, which shows this test or none."""
        words = json.dumps([name, test_id, round(self.clock.unix_s())], separators=(",", ":")).encode()
        return f"{_text(words)}.{_text(self._sign(words))}"

    def holder(self, text: str | None, running: Collection[str | None] = ()) -> str | None:
        """Whose page it was given to; None where it is no right, or none any more."""
        if not text or len(text) > LONGEST or not text.isascii():
            return None
        words, _, mark = text.partition(".")
        try:
            said = base64.urlsafe_b64decode(words + "=" * (-len(words) % 4))
            signed = base64.urlsafe_b64decode(mark + "=" * (-len(mark) % 4))
        except (binascii.Error, ValueError):
            return None
        if not hmac.compare_digest(signed, self._sign(said)):
            return None
        name, test_id, given_s = json.loads(said)
        young = self.clock.unix_s() - given_s <= RIGHT_S
        return name if young or (test_id is not None and test_id in running) else None

    def _sign(self, words: bytes) -> bytes:
        return hmac.digest(self._key, b"stop\0" + words, "sha256")


def _text(value: bytes) -> str:
    return base64.urlsafe_b64encode(value).decode().rstrip("=")


@dataclass(frozen=True)
class Press:
    """A stop that is allowed: who pressed it, and why."""

    by: str
    reason: str


async def anyone_who_may_stop(request: Request) -> Press:
    """A dependency for stop: who holds a page's right, or is signed in, be it that the session or token ran out.

    The right is looked at first: it needs no database, and nothing that holds back guesses holds it back.
    """
    coming = asyncio.create_task(_sent(request))
    try:
        reason, by = await _within(PATIENCE_S, request, coming)
        if by is not None:
            return Press(by, reason)
        try:
            return Press(request.app.state.context.auth.identify(request, forgive_age=True).name, reason)
        except ApiError as error:
            reason, by = await _within(LONGEST_PATIENCE_S - PATIENCE_S, request, coming)
            if by is not None:
                return Press(by, reason)
            error.title = "Nothing was stopped"
            error.detail = f"Use the stimulator's own emergency switch now, or sign in and press stop. {error.detail}"
            raise
    finally:
        coming.cancel()


async def _within(patience_s: float, request: Request, coming: asyncio.Task[tuple[str, str]]) -> tuple[str, str | None]:
    """The reason, and whose right to stop was sent, as far as they have come in this time."""
    await asyncio.wait([coming], timeout=patience_s)
    reason, in_form = coming.result() if coming.done() else (DEFAULT_REASON, "")
    context, right = request.app.state.context, request.headers.get(HEADER) or in_form
    current, status = context.trials.current, context.rig.status
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
