"""The Unix socket: requests in, replies and events out, one JSON object per line. Also starts the stop socket.

Requests are tasks of the rig, in its own thread. The numbers of connections, of waiting requests and of bytes in a
request are limited; requests above a limit are refused at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from stimrig.rig.adapters.stop_server import MAX_LINE_BYTES, UNREADABLE, Connections, StopServer
from stimrig.rig.control.replies import head_of, id_of, refusal, to_line
from stimrig.rig.control.rig import Rig, obey, read_request
from stimrig.rig.errors import BusyError, ConfigError, PlanError, RigError
from stimrig.rig.messages import Event, StateEvent, Status, stop_socket
from stimrig.rig.requests import LONGEST_LINE, StopRequest

log = logging.getLogger("rig.socket")

LIVE_PERIOD_S = 0.05
SLOW_BYTES = 1_000_000
"""A subscriber with this many unread bytes gets no live events until it has read them."""
DEAD_BYTES = 8_000_000
LONG_LINE_BYTES = 64_000
"""Parsing a longer request blocks the interpreter for milliseconds, which would delay a test's sender."""
MAX_PENDING = 64
"""Largest number of waiting requests of one connection."""
MAX_SILENT, MAX_ACTIVE = 64, 128

Submit = Callable[[Callable[[], Coroutine[Any, Any, Any]]], Future[Any]]


class Server:
    """Serves any number of clients."""

    def __init__(self) -> None:
        self.rig: Rig
        self._submit: Submit
        self._loop: asyncio.AbstractEventLoop | None = None
        self._subscribers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._connections = Connections(MAX_SILENT, MAX_ACTIVE)
        self._server: asyncio.Server | None = None
        self._stop_server: StopServer | None = None

    def publish(self, event: Event) -> None:
        """Send an event to all subscribers; may be called from any thread."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(lambda: self._send_all(to_line(event)))

    async def start(self, rig: Rig, submit: Submit, path: Path) -> None:
        """Listen on `path` and on the stop socket; only this user and group may connect.

        `submit` starts a task of the rig, from any thread.
        """
        self._loop = asyncio.get_running_loop()
        self.rig, self._submit = rig, submit
        if await _is_listening(path):
            raise ConfigError(f"socket: {path}: another rig is listening there; stop it or use another path")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stop_server = StopServer(lambda reason, by: submit(lambda: rig.stop(reason, by)))
            self._stop_server.open(stop_socket(path))  # first: whoever can send a request can also stop
            path.unlink(missing_ok=True)
            self._server = await asyncio.start_unix_server(self._serve, path, limit=LONGEST_LINE, backlog=512)
            path.chmod(0o660)
        except OSError as error:
            raise ConfigError(
                f"socket: {path}: {error.strerror or error}; use a short path in a writable folder"
            ) from None
        self._track(self._loop.create_task(self._live()))

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        if self._stop_server is not None:
            await asyncio.to_thread(self._stop_server.close)
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _track(self, task: asyncio.Task[None]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _live(self) -> None:
        while True:
            await asyncio.sleep(LIVE_PERIOD_S)
            try:
                event = self.rig.take_live()
                if event is not None and self._subscribers:
                    self._send_all(to_line(event), live=True)
            except Exception:  # this one is lost, the next may do
                log.exception("a live event could not be made")

    def _send_all(self, line: bytes, live: bool = False) -> None:
        for writer in tuple(self._subscribers):
            if writer.transport.is_closing():  # it left while its subscription was still being answered
                self._subscribers.discard(writer)
                continue
            waiting = writer.transport.get_write_buffer_size()
            if waiting > DEAD_BYTES:
                self._subscribers.discard(writer)
                writer.transport.abort()
            elif waiting < SLOW_BYTES or not live:
                writer.write(line)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        pending: set[asyncio.Task[None]] = set()
        self._connections.enter(writer.transport)
        try:
            while line := await reader.readline():
                if line.strip():
                    self._connections.spoke(writer.transport)
                    # each request is its own task, so that a stop never waits behind another request
                    task = asyncio.create_task(self._answer(line, writer, len(pending) >= MAX_PENDING))
                    pending.add(task)
                    task.add_done_callback(pending.discard)
                    self._track(task)
        except ValueError:
            _write(writer, to_line(refusal(0, PlanError(f"request: longer than {LONGEST_LINE // 1000} kB"))))
        except ConnectionError as error:
            log.warning("client disconnected: %s", error)
        finally:
            self._subscribers.discard(writer)
            self._connections.remove(writer.transport)
            await asyncio.gather(*pending, return_exceptions=True)
            writer.close()
            with contextlib.suppress(ConnectionError, OSError):
                await writer.wait_closed()

    async def _answer(self, line: bytes, writer: asyncio.StreamWriter, crowded: bool) -> None:
        head = head_of(line)
        if head and head[0] == "stop" and self._stop_server is not None:
            if len(line) > MAX_LINE_BYTES:  # it stops, but is not parsed: that would delay the sender
                line = to_line(StopRequest(id=head[1], reason=UNREADABLE))
            _write(writer, to_line(await self._stop_server.answer(line)))
            return
        try:
            if crowded:
                raise BusyError(f"{MAX_PENDING} requests of this connection are waiting; read their replies first")
            if len(line) > LONG_LINE_BYTES and not head:
                size_kb = LONG_LINE_BYTES // 1000
                raise PlanError(f"request: if over {size_kb} kB, it must begin with its kind and its id")
            if len(line) > LONG_LINE_BYTES and self.rig.state.phase.busy:
                raise BusyError("a test is in progress; wait or stop it")
            request = read_request(line)
        except (RigError, ValidationError) as error:
            _write(writer, to_line(refusal(id_of(line[:LONG_LINE_BYTES]), error)))
            return
        if request.kind == "stop":  # it does not begin with its kind and id
            await self._answer(to_line(request), writer, crowded=False)
            return
        rig = self.rig
        reply = await asyncio.wrap_future(self._submit(lambda: obey(rig, request)))
        _write(writer, to_line(reply))
        if request.kind == "subscribe" and reply.ok:
            self._subscribers.add(writer)
            _write(writer, to_line(StateEvent(status=await asyncio.wrap_future(self._submit(self._status)))))

    async def _status(self) -> Status:
        return self.rig.status()


async def _is_listening(path: Path) -> bool:
    """Return whether a process is listening on that socket."""
    try:
        _, writer = await asyncio.open_unix_connection(path)
    except OSError:
        return False
    writer.close()
    return True


def _write(writer: asyncio.StreamWriter, line: bytes) -> None:
    if writer.transport.get_write_buffer_size() > DEAD_BYTES:
        writer.transport.abort()  # the client sends requests but reads no replies
    elif line and not writer.transport.is_closing():
        writer.write(line)
