"""A second socket (`SOCKET.stop`) that accepts only stops, so that other requests cannot delay one.

It has its own event loop in its own thread. It shares nothing with the requests, subscribers and half-open connections
of the first socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from pydantic import ValidationError

from stimrig.rig.control.replies import id_of, refusal, to_line
from stimrig.rig.errors import RigError
from stimrig.rig.messages import Reply, StopEvidence
from stimrig.rig.requests import StopRequest

GRACE_S = 2.0
"""So long after it came, or after its last request, a connection is closed for no other, unless too many come."""
MOST_AT_ONCE = 600
"""Most connections of a kind: a further one closes the oldest. The number exceeds a socket's backlog, so that the
oldest was read by then."""


class Connections:
    """The connections of one socket, limited so that idle clients cannot keep out an active one.

    A connection that has not yet sent a complete request is silent; the others are active. A new connection closes the
    one of its kind that has been idle longest, but none whose request may not have been read yet. So a client that
    connects is heard, however many come at once.
    """

    def __init__(self, max_silent: int, max_active: int) -> None:
        self._max_count = {False: max_silent, True: max_active}
        self._members: dict[bool, dict[asyncio.BaseTransport, float]] = {False: {}, True: {}}

    def __len__(self) -> int:
        return sum(len(members) for members in self._members.values())

    def enter(self, transport: asyncio.BaseTransport) -> None:
        self._add(transport, spoken=False)

    def spoke(self, transport: asyncio.BaseTransport) -> None:
        self.remove(transport)
        self._add(transport, spoken=True)

    def remove(self, transport: asyncio.BaseTransport) -> None:
        for members in self._members.values():
            members.pop(transport, None)

    def _add(self, transport: asyncio.BaseTransport, spoken: bool) -> None:
        members, now_s = self._members[spoken], time.monotonic()
        members[transport] = now_s  # the newest is last: dictionaries keep their order
        longest, since_s = next(iter(members.items()))
        too_many = len(members) > self._max_count[spoken] and now_s - since_s >= GRACE_S
        if too_many or len(members) > MOST_AT_ONCE:
            del members[longest]
            longest.abort() if isinstance(longest, asyncio.WriteTransport) else longest.close()


log = logging.getLogger("rig.stop")

Stop = Callable[[str, str], Future[StopEvidence]]
MAX_LINE_BYTES = 16_384
MAX_SILENT, MAX_ACTIVE = 32, 64
UNREADABLE = "a stop that could not be read"


class StopServer:
    """Serves the stop socket."""

    def __init__(self, stop: Stop) -> None:
        self._stop = stop
        self._connections = Connections(MAX_SILENT, MAX_ACTIVE)
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, name="stop-door", daemon=True)

    def open(self, path: Path) -> None:
        """Start listening. Raises OSError."""
        self._thread.start()
        path.unlink(missing_ok=True)
        asyncio.run_coroutine_threadsafe(self._listen(path), self._loop).result()
        path.chmod(0o660)

    def close(self) -> None:
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._loop.close()

    async def answer(self, line: bytes) -> Reply:
        """Stop the rig, also where the request cannot be read; the reply contains the evidence."""
        try:
            request = StopRequest.model_validate_json(line)
        except ValidationError:
            request = StopRequest(id=id_of(line), reason=UNREADABLE)
        try:
            evidence = await asyncio.wrap_future(self._stop(request.reason, request.by))
            return Reply(id=request.id, ok=True, body=evidence.model_dump(mode="json"))
        except Exception as error:
            if not isinstance(error, RigError):
                log.exception("a stop failed")
            return refusal(request.id, error)

    async def _listen(self, path: Path) -> None:
        self._server = await asyncio.start_unix_server(self._serve, path, limit=MAX_LINE_BYTES, backlog=512)

    async def _end(self) -> None:
        self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self._connections.enter(writer.transport)
        try:
            while (line := await reader.readline()).endswith(b"\n"):  # not one that was cut off
                self._connections.spoke(writer.transport)
                writer.write(to_line(await self.answer(line)))
        except ValueError:  # longer than the limit
            writer.write(to_line(await self.answer(b"")))
        except OSError as error:
            log.warning("client disconnected: %s", error)
        finally:
            self._tasks.discard(task)
            self._connections.remove(writer.transport)
            with contextlib.suppress(OSError):
                writer.close()
