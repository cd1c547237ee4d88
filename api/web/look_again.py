"""Before a change is answered, what plays is looked at again: nothing begins on what has been answered as changed."""

from __future__ import annotations

import contextlib
from typing import Any

from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.web.guards import SAFE_METHODS
from api.web.key_guard import STOP


class LookAgain:
    """ASGI middleware around every request that may change something; a stop waits for nothing.

    Parameters
    ----------
    context : Context
        Its runner looks.
    """

    def __init__(self, app: ASGIApp, context: Any) -> None:
        self.app, self.context = app, context

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] in SAFE_METHODS or scope["path"] == STOP:
            await self.app(scope, receive, send)
            return

        async def told(message: Message) -> None:
            if message["type"] == "http.response.start":
                with contextlib.suppress(SQLAlchemyError):  # it is looked at again four times a second
                    await self.context.runner.look_again()
            await send(message)

        await self.app(scope, receive, told)
