"""Before a change is answered, what plays is looked at again: nothing begins on what has been answered as changed."""

from __future__ import annotations

import logging
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api.web.guards import SAFE_METHODS
from stimrig.api.web.key_guard import STOP

log = logging.getLogger("stimrig.look_again")


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
                try:
                    await self.context.runner.look_again()
                except Exception:  # what was done is answered; it is looked at again four times a second
                    log.exception("whether a test may still be played could not be seen")
            await send(message)

        await self.app(scope, receive, told)
