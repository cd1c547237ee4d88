"""The service's end of the rig's Unix socket: asks, listens, remembers, reconnects."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import re
from collections.abc import AsyncGenerator, AsyncIterator, Callable
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

APART = (requests.StopRequest, requests.WithdrawRequest, requests.PreviewRequest)
"""Asked on connections of their own: the first two wait behind no start, and a preview is long, both ways, while the
lasting connection carries a test's live signals."""
M = TypeVar("M", bound=BaseModel)
AnyEvent = messages.StateEvent | messages.LiveEvent | messages.FinishedEvent
_events: TypeAdapter[AnyEvent] = TypeAdapter(messages.Event)


class RigClient:
    """One lasting connection to the rig, and the newest state with its age.

    `path`: the rig's socket; None: there is no rig, every request is refused with the reason. `clock`: ages are
    measured on it.
    """

    def __init__(self, path: Path | None, clock: Clock) -> None:
        self.path, self.clock = path, clock
        self.patience_s = 5.0
        self.latches: dict[str, tuple[str, str]] = {}
        """Time and reason of the stop, by the latch id that a re-arm names."""
        self._status: messages.Status | None = None
        self.connected = False
        self.listeners: list[Callable[[AnyEvent], None]] = []
        self.link_listeners: list[Callable[[bool], None]] = []
        self.poll_listeners: list[Callable[[messages.Status], None]] = []
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

    def start(self) -> None:
        """Begin to connect, in the background."""
        if self.path is not None:
            self._task = asyncio.create_task(self._stay_connected(self.path), name="rig client")

    async def close(self) -> None:
        """Close the connection."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    @property
    def age_s(self) -> float | None:
        """Seconds since the last message of the rig; None: never."""
        return None if self._heard_s is None else self.clock.monotonic_s() - self._heard_s

    async def request(self, message: Any, timeout_s: float | None = None) -> messages.Reply:
        """Ask the rig; its answer, whatever it is.

        Raises ApiError: 503 no rig, or it does not answer in time. 422 longer than the rig hears out.
        """
        timeout_s = self.patience_s if timeout_s is None else timeout_s
        if self._writer is None or isinstance(message, APART):
            return await self._request_apart(message, timeout_s)
        message = message.model_copy(update={"id": next(self._numbers)})
        future: asyncio.Future[messages.Reply] = asyncio.get_running_loop().create_future()
        self._waiting[message.id] = message, future
        try:
            self._writer.write(line_of(message))
            async with asyncio.timeout(timeout_s):  # not wait_for: in Python 3.11 it may lose a cancellation
                return await future
        except TimeoutError:
            raise no_rig(f"It did not answer within {timeout_s:g} s.") from None
        except OSError as error:
            raise no_rig(str(error)) from error
        finally:
            self._waiting.pop(message.id, None)

    async def ask(self, message: Any, timeout_s: float | None = None) -> dict[str, Any]:
        """Send a request and return the body of the reply. Raises ApiError: the rig refused."""
        reply = await self.request(message, timeout_s)
        if not reply.ok:
            problem = reply.problem
            raise from_rig(problem) if problem else no_rig("It refused without a reason.")
        return reply.body

    async def ask_for(self, answer: type[M], message: Any, timeout_s: float | None = None) -> M:
        """Ask the rig; its answer of that kind. Raises as `ask`, and 503 where it sent something else."""
        body = await self.ask(message, timeout_s)
        try:
            return answer.model_validate(body)
        except ValidationError as error:
            raise no_rig("It closed the connection, or sent something that is no answer.") from error

    async def fresh_status(self) -> messages.Status:
        """Ask for the state now; the newest that was told, which may have come behind the answer."""
        answer = await self.ask_for(messages.Status, requests.StatusRequest())
        return self.status or answer

    async def _request_apart(self, message: Any, timeout_s: float) -> messages.Reply:
        """Ask on a connection of its own; a stop at the rig's own door for stops, which nothing else can fill."""
        if self.path is None:
            raise no_rig("This service was started without one.")
        request = line_of(message)
        try:
            async with asyncio.timeout(timeout_s):
                reader, writer = await _open(self.path, isinstance(message, requests.StopRequest))
                try:
                    writer.write(request)
                    line = await reader.readline()
                    reply = messages.Reply.model_validate_json(line)
                    self._receive_state(message, reply)
                    return reply
                finally:
                    writer.close()
        except ValueError as error:  # no reply, not the protocol, or a line without an end
            raise no_rig("It closed the connection, or sent something that is no answer.") from error
        except OSError as error:  # TimeoutError is an OSError
            raise no_rig(str(error) or "It did not answer in time.") from error

    async def _stay_connected(self, path: Path) -> None:
        while True:
            try:
                reader, self._writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
                await self._listen(reader)
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
            tell_all(self.link_listeners, self.connected)

    async def _listen(self, reader: asyncio.StreamReader) -> None:
        assert self._writer is not None
        subscription = requests.SubscribeRequest(id=next(self._numbers))
        self._writer.write(subscription.model_dump_json().encode() + b"\n")
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
            try:
                status = await self.fresh_status()
                if status.state != before:  # a change without an event
                    tell_all(self.listeners, messages.StateEvent(status=status))
                tell_all(self.poll_listeners, status)
            except ApiError:
                continue  # the age of the state shows it
            except Exception:
                log.exception("the rig's state could not be taken")

    def _receive(self, message: dict[str, Any], subscription_id: int) -> None:
        if "event" in message:
            event = _events.validate_python(message)
            if isinstance(event, messages.StateEvent):
                self.status = event.status
            tell_all(self.listeners, event)
            return
        reply = messages.Reply.model_validate(message)
        if reply.id == subscription_id and reply.ok:
            self.status = messages.Status.model_validate(reply.body)
            self.connected = True
            tell_all(self.link_listeners, self.connected)
        request, future = self._waiting.get(reply.id, (None, None))
        self._receive_state(request, reply)
        if future is not None and not future.done():
            future.set_result(reply)

    def _receive_state(self, request: Any, reply: messages.Reply) -> None:
        """Store a state when it is read: its requester may resume after a later one has arrived."""
        if isinstance(request, requests.StatusRequest) and reply.ok:
            with contextlib.suppress(ValidationError):  # `ask_for` reports it
                self.status = messages.Status.model_validate(reply.body)


async def _open(path: Path, stops: bool) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A connection to the rig; for a stop at the door for stops, or at the other where that one does not open."""
    if stops:
        with contextlib.suppress(OSError):
            return await asyncio.open_unix_connection(str(messages.stop_socket(path)), limit=LINE_LIMIT)
    return await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)


def tell_all(listeners: list[Callable[[Any], None]], news: Any) -> None:
    """Call each listener; an error in one is logged and affects neither the others nor the link."""
    for listener in list(listeners):
        try:
            listener(news)
        except Exception:
            log.exception("news of the rig could not be taken")


def line_of(message: Any) -> bytes:
    """A request as a line. Raises ApiError (422) where the rig would not hear it out."""
    line = message.model_dump_json().encode() + b"\n"
    if len(line) > requests.LONGEST_LINE:
        detail = (
            f"The plan has {len(line)} bytes; the rig takes at most {requests.LONGEST_LINE}. Make the test shorter."
        )
        raise ApiError(422, "too-long", "The plan is too long", detail)
    return line


def no_rig(detail: str) -> ApiError:
    """503: the rig cannot be reached."""
    words = re.sub(r"^\[Errno \d+\] ", "", detail).rstrip(".")
    return ApiError(503, "rig-unreachable", "The rig cannot be reached", f"{words}. Is its process running?")


async def events_of(path: Path | None, test_id: str) -> AsyncGenerator[messages.LiveEvent, None]:
    """Yield the live events of a test until it has ended.

    On a connection of its own, which nothing else delays: of a reader that is slow the rig leaves out events.

    Raises ApiError: 503 the rig cannot be reached, or the connection broke before the end.
    """
    try:
        reader, writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
    except OSError as error:
        raise no_rig(str(error)) from error
    try:
        writer.write(requests.SubscribeRequest().model_dump_json().encode() + b"\n")
        async for event in _live_events(reader):
            if event.get("test_id") == test_id:
                if event["event"] == "finished":
                    return
                yield messages.LiveEvent.model_validate(event)
        raise no_rig("It closed the connection.")
    except (OSError, ValueError) as error:
        raise no_rig(str(error)) from error
    finally:
        writer.close()


async def _live_events(reader: asyncio.StreamReader) -> AsyncIterator[dict]:
    """Live and finished events; a refused subscription is an error."""
    while line := await reader.readline():
        message = json.loads(line)
        if message.get("event") in ("live", "finished"):
            yield message
        elif message.get("ok") is False:
            raise ApiError(503, "rig-unreachable", "The rig cannot be reached", "It tells nobody its samples.")
