"""The service's end of the rig's Unix socket: requests, events, the newest state, and reconnecting."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, from_rig
from stimrig.rig import messages, requests

log = logging.getLogger("stimrig.rig_client")

LINE_LIMIT = 32 * 1024 * 1024
RECONNECT_S = 0.25
STATUS_EVERY_S = 1.0
MOST_LATCHES = 100
NO_ANSWER = "It closed the connection, or sent something that is no answer."

M = TypeVar("M", bound=BaseModel)
News = messages.StateEvent | messages.LiveEvent | messages.FinishedEvent | messages.Status | bool
"""An event of the rig, a state that was polled, or whether the rig is connected."""
_events: TypeAdapter[News] = TypeAdapter(messages.Event)


class RigClient:
    """One lasting connection for the rig's events and state; each other request has a connection of its own.

    So a stop waits behind no start, and a long preview delays no live signal.

    `path`: the rig's socket; None: there is no rig, every request is refused with the reason. `listeners`: called with
    all news; an error in one is logged and affects neither the others nor the connection.
    """

    def __init__(self, path: Path | None, clock: Clock) -> None:
        self.path, self.clock = path, clock
        self.patience_s = 5.0
        self.connected = False
        self.listeners: list[Callable[[News], None]] = []
        self.latches: dict[str, tuple[str, str]] = {}
        """Time and reason of the stop, by the latch id that a re-arm names."""
        self._status: messages.Status | None = None
        self._heard_s: float | None = None
        self._waiting: list[asyncio.Future[None]] = []
        """Who asked for the state on the lasting connection, in turn."""
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def status(self) -> messages.Status | None:
        """Return the newest state."""
        return self._status

    @status.setter
    def status(self, status: messages.Status) -> None:
        self._status = status
        if status.latch not in self.latches:
            while len(self.latches) >= MOST_LATCHES:
                self.latches.pop(next(iter(self.latches)))
            self.latches[status.latch] = self.clock.utc(), status.reason

    @property
    def age_s(self) -> float | None:
        """Seconds since the last message of the rig; None: never."""
        return None if self._heard_s is None else self.clock.monotonic_s() - self._heard_s

    def start(self) -> None:
        """Begin to connect, in the background."""
        if self.path is not None:
            self._task = asyncio.create_task(self._stay_connected(self.path), name="rig client")

    async def close(self) -> None:
        """Close the connection."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def ask(self, message: Any, timeout_s: float | None = None) -> dict[str, Any]:
        """Send a request and return the body of the reply; a stop goes to the rig's own socket for stops.

        Raises ApiError: what the rig refuses. 503 no rig, or it does not answer in time. 422 the request is too long.
        """
        if self.path is None:
            raise no_rig("This service was started without one.")
        request, opened, timeout_s = line_of(message), None, self.patience_s if timeout_s is None else timeout_s
        try:
            async with asyncio.timeout(timeout_s):  # not wait_for: in Python 3.11 it may lose a cancellation
                if isinstance(message, requests.StopRequest):  # which nothing else can fill
                    with contextlib.suppress(OSError):
                        stops = str(messages.stop_socket(self.path))
                        opened = await asyncio.open_unix_connection(stops, limit=LINE_LIMIT)
                reader, writer = opened or await asyncio.open_unix_connection(str(self.path), limit=LINE_LIMIT)
                try:
                    writer.write(request)
                    reply = messages.Reply.model_validate_json(await reader.readline())
                finally:
                    writer.close()
        except TimeoutError:
            raise no_rig(f"It did not answer within {timeout_s:g} s.") from None
        except OSError as error:
            raise no_rig(str(error)) from error
        except ValueError as error:  # no reply, not the protocol, or a line without an end
            raise no_rig(NO_ANSWER) from error
        if not reply.ok:
            raise from_rig(reply.problem) if reply.problem else no_rig("It refused without a reason.")
        return reply.body

    async def ask_for(self, answer: type[M], message: Any, timeout_s: float | None = None) -> M:
        """Send a request and return its answer of that kind. Raises as `ask`, and 503 where it is something else."""
        body = await self.ask(message, timeout_s)
        try:
            return answer.model_validate(body)
        except ValidationError as error:
            raise no_rig(NO_ANSWER) from error

    async def fresh_status(self) -> messages.Status:
        """Ask for the state; return the newest one, which may have come behind the answer.

        On the lasting connection, where answers and events come in their order: no older state takes a newer one's
        place. Raises as `ask_for`.
        """
        if self._writer is None:
            self.status = answer = await self.ask_for(messages.Status, requests.StatusRequest())
            return answer
        told = asyncio.get_running_loop().create_future()
        self._waiting.append(told)
        self._writer.write(line_of(requests.StatusRequest()))
        try:
            async with asyncio.timeout(self.patience_s):
                await told
        except TimeoutError:
            raise no_rig(f"It did not answer within {self.patience_s:g} s.") from None
        assert self._status is not None
        return self._status

    async def _stay_connected(self, path: Path) -> None:
        while True:
            try:
                reader, self._writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
                await self._listen(reader, self._writer)
            except (OSError, ValueError, asyncio.IncompleteReadError) as error:
                log.debug("rig link: %s", error)
            except Exception:  # without a reconnect the service would miss the end of every test
                log.exception("the rig's link failed")
            finally:
                self._lose_link()
            await asyncio.sleep(RECONNECT_S)

    def _lose_link(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        for told in self._waiting:
            if not told.done():
                told.set_exception(no_rig("The connection to the rig broke."))
        self._waiting.clear()
        if self.connected:
            log.warning("the rig's socket closed")
            self.connected = False
            self._notify(False)

    async def _listen(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(line_of(requests.SubscribeRequest()))
        poll = asyncio.create_task(self._poll(), name="rig poll")
        try:
            while line := await reader.readline():
                self._heard_s = self.clock.monotonic_s()
                self._receive(json.loads(line))
        finally:
            poll.cancel()

    async def _poll(self) -> None:
        """Ask for the state now and then, so that its age says whether the rig still answers."""
        while True:
            await asyncio.sleep(STATUS_EVERY_S)
            before = self.status.state if self.status else None
            with contextlib.suppress(ApiError):  # the age of the state shows it
                status = await self.fresh_status()
                if status.state != before:  # a change without an event
                    self._notify(messages.StateEvent(status=status))
                self._notify(status)

    def _receive(self, message: dict[str, Any]) -> None:
        """Take an event, or a state: the answer to the subscription, or to who waits for it first."""
        if "event" in message:
            event = _events.validate_python(message)
            if isinstance(event, messages.StateEvent):
                self.status = event.status
            self._notify(event)
            return
        reply, waits = messages.Reply.model_validate(message), self._waiting if self.connected else []
        told = waits.pop(0) if waits else None
        if reply.ok:
            self.status = messages.Status.model_validate(reply.body)
        if told is not None and not told.done():
            told.set_result(None) if reply.ok else told.set_exception(no_rig("It does not tell its state."))
        if reply.ok and not self.connected:
            self.connected = True
            self._notify(True)

    def _notify(self, news: News) -> None:
        for listener in list(self.listeners):
            try:
                listener(news)
            except Exception:
                log.exception("news of the rig could not be taken")


def line_of(message: Any) -> bytes:
    """Return a request as a line. Raises ApiError (422): the rig would not read one that long."""
    line = message.model_dump_json().encode() + b"\n"
    if len(line) > requests.LONGEST_LINE:
        detail = f"The plan has {len(line)} bytes; the rig takes at most {requests.LONGEST_LINE}. Shorten the test."
        raise ApiError(422, "too-long", "The plan is too long", detail)
    return line


def no_rig(detail: str) -> ApiError:
    """503: the rig cannot be reached."""
    words = re.sub(r"^\[Errno \d+\] ", "", detail).rstrip(".")
    return ApiError(503, "rig-unreachable", "The rig cannot be reached", f"{words}. Is its process running?")
