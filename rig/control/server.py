"""The Unix socket: requests in, replies and events out, one JSON object a line."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from rig.control.rig import Rig
from rig.errors import ConfigError, RigError
from rig.messages import Event, LiveEvent, Problem, Reply, Request, StateEvent

log = logging.getLogger("rig.socket")

LIVE_PERIOD_S = 0.05
WORKERS = 32
"""Requests that may wait at the same time: those who wait for a stop's evidence must not hold up another stop."""
SLOW_BYTES = 1_000_000
"""A subscriber that lets this much wait gets no live events until it has caught up."""
DEAD_BYTES = 8_000_000
MAX_LINE_BYTES = 4_000_000

_REQUEST: TypeAdapter[Any] = TypeAdapter(Request)


class Server:
    """Serves any number of clients; what touches a device or the disk runs in worker threads."""

    def __init__(self) -> None:
        self.rig: Rig | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._subscribers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    def publish(self, event: Event) -> None:
        """Send an event to every subscriber; from any thread."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._send_all, event)

    async def start(self, rig: Rig, path: Path) -> None:
        """Listen on `path`; only this user and group may connect."""
        self._loop = asyncio.get_running_loop()
        self.rig = rig
        self._loop.set_default_executor(ThreadPoolExecutor(WORKERS, "request"))
        if await _answers(path):
            raise ConfigError(f"socket: {path}: another rig listens there; stop it or give another path")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            self._server = await asyncio.start_unix_server(self._serve, path, limit=MAX_LINE_BYTES)
            path.chmod(0o660)
        except OSError as error:
            raise ConfigError(f"socket: {path}: {error.strerror or error}; a short path in a writable folder") from None
        self._keep(self._loop.create_task(self._live()))

    async def close(self) -> None:
        """Stop listening and let every client go."""
        if self._server is not None:
            self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _keep(self, task: asyncio.Task[None]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _live(self) -> None:
        assert self.rig is not None
        while True:
            await asyncio.sleep(LIVE_PERIOD_S)
            event = self.rig.live()
            if event is not None:
                self._send_all(event)

    def _send_all(self, event: Event) -> None:
        if not self._subscribers:
            return
        line = _line(event)
        for writer in tuple(self._subscribers):
            waiting = writer.transport.get_write_buffer_size()
            if waiting > DEAD_BYTES:
                self._subscribers.discard(writer)
                writer.transport.abort()
            elif waiting < SLOW_BYTES or not isinstance(event, LiveEvent):
                writer.write(line)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        pending: set[asyncio.Task[None]] = set()
        try:
            while line := await reader.readline():
                if line.strip():
                    # each request is its own task, so that a stop never waits behind another request
                    task = asyncio.create_task(self._answer(line, writer))
                    pending.add(task)
                    task.add_done_callback(pending.discard)
                    self._keep(task)
        except (ConnectionError, ValueError) as error:
            log.warning("client let go: %s", error)
        finally:
            self._subscribers.discard(writer)
            await asyncio.gather(*pending, return_exceptions=True)
            writer.close()
            with contextlib.suppress(ConnectionError, OSError):
                await writer.wait_closed()

    async def _answer(self, line: bytes, writer: asyncio.StreamWriter) -> None:
        try:
            request = _REQUEST.validate_json(line)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"]) or "request"
            problem = Problem(code="bad-plan", title="The request is wrong", detail=f"{place}: {first['msg']}")
            _write(writer, Reply(id=_id_of(line), ok=False, problem=problem))
            return
        try:
            body = await asyncio.to_thread(self._do, request)
            reply = Reply(id=request.id, ok=True, body=body.model_dump(mode="json"))
        except RigError as error:
            reply = Reply(id=request.id, ok=False, problem=problem_of(error))
        except Exception as error:
            log.exception("request %s failed", request.kind)
            problem = Problem(code="internal", title=RigError.title, detail=f"{type(error).__name__}: {error}")
            reply = Reply(id=request.id, ok=False, problem=problem)
        _write(writer, reply)
        if request.kind == "subscribe" and reply.ok and self.rig is not None:
            self._subscribers.add(writer)
            _write(writer, StateEvent(status=self.rig.status()))

    def _do(self, request: Any) -> BaseModel:
        assert self.rig is not None
        match request.kind:
            case "preview":
                return self.rig.preview(request)
            case "start":
                return self.rig.start(request.plan)
            case "stop":
                return self.rig.stop(request.reason, request.by)
            case "rearm":
                return self.rig.rearm(request.by)
            case "calibrate-start":
                return self.rig.calibrate(request)
            case "calibrate-step":
                return self.rig.calibrate_step(request.direction)
            case "calibrate-mark":
                return self.rig.calibrate_mark(request.threshold)
            case "calibrate-finish":
                return self.rig.calibrate_finish(request.by, request.discard)
            case _:
                return self.rig.status()


async def _answers(path: Path) -> bool:
    """Does a live process listen on that socket?"""
    try:
        _, writer = await asyncio.open_unix_connection(path)
    except OSError:
        return False
    writer.close()
    return True


def problem_of(error: RigError) -> Problem:
    """An exception as clients see it."""
    return Problem(code=error.code, title=error.title, detail=str(error))


def _line(message: BaseModel) -> bytes:
    return message.model_dump_json().encode() + b"\n"


def _write(writer: asyncio.StreamWriter, message: BaseModel) -> None:
    if not writer.transport.is_closing():
        writer.write(_line(message))


def _id_of(line: bytes) -> int:
    with contextlib.suppress(ValueError, TypeError, AttributeError):
        return int(json.loads(line).get("id", 0))
    return 0
