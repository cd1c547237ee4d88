"""A service whose answers to a browser come late and in pieces, as on a busy machine: what a page's test must outlive.

A test that looks at a page once, where a person would wait, passes on a quiet machine and fails one day on another.
Here it fails at once.
"""

from __future__ import annotations

import asyncio
from random import Random
from typing import Any

LATEST_S = 0.3
"""Most pieces come sooner: the delays are squares of even ones."""
PIECES = 3


class LateAnswers:
    """An ASGI application in front of another one.

    Parameters
    ----------
    app : the application; whatever else is asked of this one is its own.
    seed : the delays' own.
    """

    def __init__(self, app: Any, seed: int) -> None:
        self.app, self.random = app, Random(seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.app, name)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if b"Mozilla" not in dict(scope.get("headers", [])).get(b"user-agent", b""):
            await self.app(scope, receive, send)
            return
        await self.later()
        await self.app(scope, receive, lambda message: self.sent(message, send))

    async def later(self) -> None:
        await asyncio.sleep(self.random.random() ** 2 * LATEST_S)

    async def sent(self, message: Any, send: Any) -> None:
        """In pieces, each after a while of its own; what is short is one piece."""
        body = message.get("body", b"")
        pieces = PIECES if len(body) > 1000 else 1
        cuts = sorted(self.random.randrange(len(body)) for _ in range(pieces - 1))
        for begin, end in zip([0, *cuts], cuts, strict=False):
            await self.later()
            await send({**message, "body": body[begin:end], "more_body": True})
        await self.later()
        await send({**message, "body": body[cuts[-1] if cuts else 0 :]} if "body" in message else message)
