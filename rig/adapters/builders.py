"""Previews, which the rig has built by a process beside it, `stimrig.rig.builder`.

So a plan takes no memory or processor time from the rig's sender. Previews are built one at a time, with limits on
memory and time; requests that would have to wait too long are refused at once.
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

log = logging.getLogger("rig.builders")

MAX_WAITING = 8
MAX_START_S = 20.0
"""Real seconds after which a builder that has not begun is given up. An idle computer needs half a second."""
MAX_BUILD_S = 30.0
"""Real seconds allowed for one preview. The longest test needs 0.1 s of processor time, at the lowest priority."""
MAX_REPLY_BYTES = 8_000_000


class Previews:
    """Sends requests for previews to a process, started when first needed, and again if it has died or taken too long.

    `table`, `speed`: of the rig.
    """

    def __init__(self, table: dict[str, Limit], speed: float) -> None:
        rows = {name: asdict(row) for name, row in table.items()}
        self._first = json.dumps({"table": rows, "speed": speed}).encode() + b"\n"
        self._lock = asyncio.Lock()
        self._waiting = 0
        self._process: asyncio.subprocess.Process | None = None

    async def warm(self) -> None:
        """Start it, so that the first request does not wait for it: on a busy computer that takes seconds."""
        async with self._lock:
            try:
                await self._begin()
            except OSError as error:  # it is started again when it is needed
                log.warning("the builder of previews did not start: %r", error)

    async def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def _begin(self) -> asyncio.subprocess.Process:
        """The process, once it has said that it takes requests."""
        if self._process is None or self._process.returncode is not None:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "stimrig.rig.builder",
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=MAX_REPLY_BYTES,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                process.stdin.write(self._first)
                if not await asyncio.wait_for(process.stdout.readline(), MAX_START_S):
                    raise ConnectionError("the builder has died")
            except BaseException:  # a cancelled one, too: its first line is no reply to the next request
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
                raise
            self._process = process
        return self._process

    async def _exchange(self, process: asyncio.subprocess.Process, request: bytes) -> bytes:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(request)
        await process.stdin.drain()
        reply = await process.stdout.readline()
        if not reply.endswith(b"\n"):
            raise ConnectionError("the builder has died")
        return reply

    async def reply(self, line: bytes, angle_set_at_utc: str | None = None) -> bytes:
        """Reply to a preview request; both are one line of JSON. `angle_set_at_utc`: see `check_range`.

        Raises BusyError: too many requests are waiting. PlanError: it took too much memory.
        """
        if self._waiting >= MAX_WAITING:
            raise BusyError(f"previews: {self._waiting} requests are waiting; try again in a moment")
        self._waiting += 1
        request = json.dumps(angle_set_at_utc).encode() + b"\n" + line.rstrip(b"\n") + b"\n"
        try:
            async with self._lock:
                process = await self._begin()  # its start is not part of the time
                return await asyncio.wait_for(self._exchange(process, request), MAX_BUILD_S)
        except TimeoutError:
            await self.close()
            raise BusyError(f"preview: not built within {MAX_BUILD_S:g} s, the computer is busy; try again") from None
        except (OSError, ValueError):
            await self.close()
            raise PlanError("preview: it could not be built; make the plan shorter") from None
        finally:
            self._waiting -= 1
