"""A worker beside the pool: of adaptive tests, whose test it keeps from one question to the next, or of trials."""

from __future__ import annotations

import asyncio
import itertools
import logging
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.workers.process import WORKER, Call, Places, Worker

log = logging.getLogger("stimrig.adviser")


class Adviser:
    """Answers one question at a time, beside the pool: nothing else keeps it busy.

    It is started by the first question, so whoever asks none has no such process. For an adaptive test that is what it
    can reach: during the test it is warm.

    Parameters
    ----------
    command : tuple of str
        How to start the worker; tests put another in its place.
    places : Places
        The folders that it may reach.
    """

    def __init__(self, command: tuple[str, ...] = WORKER, places: Places | None = None) -> None:
        self.worker = Worker(command, places or Places())
        self._numbers = itertools.count(1)
        self._turn = asyncio.Lock()
        self._knows: asyncio.subprocess.Process | None = None
        """The process that keeps the test."""

    async def ask(self, verb: str, **arguments: Any) -> dict[str, Any]:
        """Its answer.

        Raises
        ------
        ApiError
            The worker refused, took too long or died; the next question starts a new one, which knows of no test.
        """
        async with self._turn:
            if verb == "adaptive_advise" and await self.worker.start() is not self._knows:
                detail = "It ended between two questions. Your data are safe. See logs/api.log."
                raise ApiError(500, "worker-died", "The worker process died", detail)
            if verb == "adaptive_begin":
                self._knows = None
            found = await self.worker.run(Call(next(self._numbers), verb, arguments))
            if verb == "adaptive_begin":
                self._knows = self.worker.process
            return found

    async def close(self) -> None:
        """End the process."""
        await self.worker.close()
