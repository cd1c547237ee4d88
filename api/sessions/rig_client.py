"""The service's end of the rig's Unix socket: requests, events, the newest state, and reconnecting."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import re
from collections.abc import AsyncGenerator, Callable
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

APART = (requests.StopRequest, requests.WithdrawRequest, requests.PreviewRequest)
"""Asked on connections of their own: the first two wait behind no start, and a preview is long, both ways, while the
lasting connection carries a test's live signals."""
M = TypeVar("M", bound=BaseModel)
News = messages.StateEvent | messages.LiveEvent | messages.FinishedEvent | messages.Status | bool
"""An event of the rig, a state that was polled, or whether the rig is connected."""
_events: TypeAdapter[News] = TypeAdapter(messages.Event)


class RigClient:
    """One lasting connection to the rig, and the newest state with its age.

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
        self._numbers = itertools.count(1)
        self._waiting: dict[int, tuple[Any, asyncio.Future[messages.Reply]]] = {}
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
        """Send a request and return the body of the reply.

        Raises ApiError: what the rig refuses. 503 no rig, or it does not answer in time. 422 the request is too long.
        """
        timeout_s = self.patience_s if timeout_s is None else timeout_s
        try:
            async with asyncio.timeout(timeout_s):  # not wait_for: in Python 3.11 it may lose a cancellation
                if self._writer is None or isinstance(message, APART):
                    reply = await self._ask_apart(message)
                else:
                    reply = await self._ask_here(message, self._writer)
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
        """Ask for the state; return the newest one, which may have come behind the answer."""
        answer = await self.ask_for(messages.Status, requests.StatusRequest())
        return self.status or answer

    async def _ask_here(self, message: Any, writer: asyncio.StreamWriter) -> messages.Reply:
        message = message.model_copy(update={"id": next(self._numbers)})
        future: asyncio.Future[messages.Reply] = asyncio.get_running_loop().create_future()
        self._waiting[message.id] = message, future
        try:
            writer.write(line_of(message))
            return await future
        finally:
            self._waiting.pop(message.id, None)

    async def _ask_apart(self, message: Any) -> messages.Reply:
        """Ask on a connection of its own; a stop at the rig's own socket for stops, which nothing else can fill."""
        if self.path is None:
            raise no_rig("This service was started without one.")
        request, limit = line_of(message), LINE_LIMIT
        opened = None
        if isinstance(message, requests.StopRequest):
            with contextlib.suppress(OSError):
                opened = await asyncio.open_unix_connection(str(messages.stop_socket(self.path)), limit=limit)
        reader, writer = opened or await asyncio.open_unix_connection(str(self.path), limit=limit)
        try:
            writer.write(request)
            reply = messages.Reply.model_validate_json(await reader.readline())
            self._take_state(message, reply)
            return reply
        finally:
            writer.close()

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
        for _, future in self._waiting.values():
            if not future.done():
                future.set_exception(no_rig("The connection to the rig broke."))
        if self.connected:
            log.warning("the rig's socket closed")
            self.connected = False
            self._notify(False)

    async def _listen(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        subscription = requests.SubscribeRequest(id=next(self._numbers))
        writer.write(line_of(subscription))
        poll = asyncio.create_task(self._poll(), name="rig poll")
        try:
            while line := await reader.readline():
                self._heard_s = self.clock.monotonic_s()
                self._receive(json.loads(line), subscription.id)
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

    def _receive(self, message: dict[str, Any], subscription_id: int) -> None:
        if "event" in message:
            event = _events.validate_python(message)
            if isinstance(event, messages.StateEvent):
                self.status = event.status
            self._notify(event)
            return
        reply = messages.Reply.model_validate(message)
        if reply.id == subscription_id and reply.ok:
            self.status = messages.Status.model_validate(reply.body)
            self.connected = True
            self._notify(True)
        request, future = self._waiting.get(reply.id, (None, None))
        self._take_state(request, reply)
        if future is not None and not future.done():
            future.set_result(reply)

    def _take_state(self, request: Any, reply: messages.Reply) -> None:
        """Keep a state when it is read: its requester may resume after a later one has arrived."""
        if isinstance(request, requests.StatusRequest) and reply.ok:
            with contextlib.suppress(ValidationError):  # `ask_for` reports it
                self.status = messages.Status.model_validate(reply.body)

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


async def events_of(path: Path | None, test_id: str) -> AsyncGenerator[messages.LiveEvent, None]:
    """Yield the live events of a test until it has ended.

    On a connection of its own, which nothing else delays: the rig leaves out events for a slow reader.

    Raises ApiError: 503 the rig cannot be reached, or the connection broke before the end.
    """
    try:
        reader, writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
        try:
            writer.write(line_of(requests.SubscribeRequest()))
            while line := await reader.readline():
                message = json.loads(line)
                if message.get("ok") is False:
                    raise no_rig("It refuses to send its samples.")
                if message.get("test_id") == test_id and message["event"] == "finished":
                    return
                if message.get("test_id") == test_id and message["event"] == "live":
                    yield messages.LiveEvent.model_validate(message)
        finally:
            writer.close()
    except (OSError, ValueError) as error:
        raise no_rig(str(error)) from error
    raise no_rig("It closed the connection.")
