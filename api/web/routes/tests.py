"""Tests: start, progress by polling and over a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any
from urllib.parse import urlsplit

from fastapi import APIRouter, Response, WebSocket, WebSocketDisconnect

from api.errors import ApiError, NotFoundError
from api.people.auth import Scope
from api.sessions.requests import TestIn
from api.store.tables import Test
from api.web.dependencies import PROBLEM, Context, Ctx, LiveReader, Tester, of
from api.web.responses.base import answers
from api.web.responses.rig import TestOut

router = APIRouter(prefix="/v1/tests", tags=["tests"], responses=PROBLEM)


def find(context: Context, test_id: str) -> Test:
    """A test by its id; 404 where there is none."""
    row = context.store.get(Test, test_id)
    if row is None:
        raise NotFoundError("test", test_id, "GET /v1/tests lists them.")
    return row


@router.post("", status_code=202, **answers(TestOut, 202, "begun; see `Location`"))
async def start_test(context: Ctx, who: Tester, body: TestIn, response: Response) -> dict[str, Any]:
    """Start a test; `Location` is where its progress is read. One at a time: 409 names the holder."""
    row = await context.runner.start(body, who.name)
    response.headers["Location"] = f"/v1/tests/{row.id}"
    return context.runner.document(row)


@router.get("", **answers(list[TestOut]))
def list_tests(context: Ctx, _who: LiveReader, limit: int = 50) -> list[dict[str, Any]]:
    """The newest tests."""
    rows = context.store.all(Test, order=Test.requested_utc.desc(), limit=max(1, min(limit, 500)))
    return [context.runner.document(row) for row in rows]


@router.get("/{test_id}", **answers(TestOut))
def one_test(context: Ctx, _who: LiveReader, test_id: str) -> dict[str, Any]:
    """A test: state, segment, progress, time left; at its end recording, model, summary and fit."""
    return context.runner.document(find(context, test_id))


@router.websocket("/{test_id}/live")
async def live(socket: WebSocket, test_id: str) -> None:
    """Live signals: `history` first, then `live` about 20 a second, `state`, `link`, and `test` at every turn.

    The socket closes (1000) once the test has ended and its last `test` message was sent.
    """
    context = of(socket)
    await socket.accept()
    try:
        row = await asyncio.to_thread(_admit, socket, context, test_id)
    except ApiError as error:
        await socket.send_json({"type": "problem", "problem": error.body(socket.url.path)})
        await socket.close(4404 if error.status == 404 else 4401, error.title)
        return
    queue = context.runner.hub.open()
    try:
        await _pump(socket, context, row, queue)
    except (WebSocketDisconnect, RuntimeError):
        pass
    finally:
        context.runner.hub.close(queue)


def _admit(socket: WebSocket, context: Context, test_id: str) -> Test:
    principal = context.auth.identify(socket)
    if not principal.may(Scope.READ_LIVE):
        raise ApiError(403, "forbidden", "Not allowed", f"This needs the scope {Scope.READ_LIVE}.")
    origin = socket.headers.get("origin")
    if principal.csrf is not None and origin and urlsplit(origin).netloc != socket.headers.get("host"):
        raise ApiError(403, "forbidden", "Not allowed", "The request came from a page of another site.")
    return find(context, test_id)


async def _pump(socket: WebSocket, context: Context, row: Test, queue: asyncio.Queue[dict[str, Any]]) -> None:
    gone = asyncio.create_task(_until_gone(socket))
    try:
        history = queue.get_nowait()
        if history["test_id"] == row.id:
            await socket.send_json(history)
        document = await asyncio.to_thread(lambda: context.runner.document(find(context, row.id)))
        await socket.send_json({"type": "test", "test": document})
        while not document["done"] and not gone.done():
            try:
                message = await asyncio.wait_for(queue.get(), 1.0)
            except TimeoutError:
                message = {"type": "idle", "rig_connected": context.rig.connected}
            if message["type"] == "test":
                if message["test"]["id"] != row.id:
                    continue
                document = message["test"]
            if message["type"] == "live" and message["test_id"] != row.id:
                continue
            await socket.send_json(message)
        with contextlib.suppress(RuntimeError):
            await socket.close()
    finally:
        gone.cancel()


async def _until_gone(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            await socket.receive_text()
