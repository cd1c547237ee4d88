"""Previews are built by another process, `stimrig.rig.builder`, one at a time, with limits on memory and time.

So no plan can take memory or processor time from the rig's sender. Requests that would have to wait too long are
refused at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import sys
from dataclasses import asdict

from stimrig.rig.errors import BusyError, PlanError
from stimrig.rig.limits import Limit

log = logging.getLogger("rig.previews")

MAX_WAITING = 8
MAX_BUILD_S = 30.0
"""Real seconds allowed for one preview. The longest test needs 0.1 s of processor time, at the lowest priority."""
MAX_REPLY_BYTES = 8_000_000


class Previews:
    """Sends requests to the builder, and starts it again if it has died or taken too long."""

    def __init__(self, table: dict[str, Limit], speed: float) -> None:
        rows = {name: asdict(row) for name, row in table.items()}
        self._settings = json.dumps({"table": rows, "speed": speed}).encode() + b"\n"
        self._one = asyncio.Lock()
        self._waiting = 0
        self._process: asyncio.subprocess.Process | None = None

    async def warm(self) -> None:
        """Start the builder, so that the first preview does not wait for it."""
        async with self._one:
            await self._begin()

    async def reply(self, line: bytes, angle_set_at_utc: str | None = None) -> bytes:
        """Reply to a preview request; both are one line of JSON. `angle_set_at_utc`: see `check_range`.

        Raises
        ------
        BusyError
            Too many requests are waiting.
        PlanError
            It took too much memory.
        """
        if self._waiting >= MAX_WAITING:
            raise BusyError(f"previews: {self._waiting} requests are waiting; try again in a moment")
        self._waiting += 1
        try:
            async with self._one:
                return await asyncio.wait_for(self._ask(line, angle_set_at_utc), MAX_BUILD_S)
        except TimeoutError:
            await self.close()
            raise BusyError(f"preview: not built within {MAX_BUILD_S:g} s, the computer is busy; try again") from None
        except (OSError, ValueError):
            await self.close()
            raise PlanError("preview: it could not be built; make the plan shorter") from None
        finally:
            self._waiting -= 1

    async def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def _begin(self) -> asyncio.subprocess.Process:
        if self._process is None or self._process.returncode is not None:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "stimrig.rig.builder",
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=MAX_REPLY_BYTES,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
            assert self._process.stdin is not None
            self._process.stdin.write(self._settings)
        return self._process

    async def _ask(self, line: bytes, angle_set_at_utc: str | None) -> bytes:
        process = await self._begin()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(angle_set_at_utc).encode() + b"\n" + line.rstrip(b"\n") + b"\n")
        await process.stdin.drain()
        reply = await process.stdout.readline()
        if not reply.endswith(b"\n"):
            raise ConnectionError("the preview builder has died")
        return reply
