"""Tests: start, progress by polling and over a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response, WebSocket, WebSocketDisconnect
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.clinical_words import missing_words
from stimrig.api.errors import ApiError, forbidden
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services import tests
from stimrig.api.sessions import controllers
from stimrig.api.sessions.requests import TestIn
from stimrig.api.store.tables import Test
from stimrig.api.web.dependencies import (
    PROBLEM,
    Context,
    Ctx,
    LiveReader,
    ParticipantVersion,
    Tester,
)
from stimrig.api.web.guards import refuse_outside, same_origin
from stimrig.api.web.openapi import problem
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.rig import TestOut
from stimrig.rig.messages import Extended

log = logging.getLogger("stimrig.live")
LOOK_S = 1.0
"""Interval at which a live channel checks that its session or token is still valid."""
GOODBYE_S = 2.0
"""So long it waits for a client that reads nothing to hear why it is closed."""
router = APIRouter(prefix="/v1/tests", tags=["tests"], responses=PROBLEM)
BEGUN = describe_answer(TestOut, 202, "begun; see `Location`")
BEGUN["responses"][410] = problem("the previewed plan is not known, or too old")


@router.post("", status_code=202, **BEGUN)
async def start_test(
    context: Ctx, principal: Tester, tags: ParticipantVersion, body: TestIn, response: Response
) -> dict[str, Any]:
    """Start a test; `Location` is where its progress is read. One at a time: 409 names the holder.

    A controller's key, which reads no participant, sends the `ETag` of `GET /v1/participants/{code}/model`.
    """
    row = await controllers.start(context.runner, principal, body, tags)
    response.headers["Location"] = f"/v1/tests/{row.id}"
    return await asyncio.to_thread(context.runner.document, row)


@router.get("", **describe_answer(list[TestOut]))
def list_tests(
    context: Ctx,
    _principal: LiveReader,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    participant: str | None = None,
) -> list[dict[str, Any]]:
    """The newest tests, of all participants or of one."""
    return tests.newest(context, limit, participant)


@router.get("/{test_id}", **describe_answer(TestOut))
def one_test(context: Ctx, _principal: LiveReader, test_id: str) -> dict[str, Any]:
    """A test: state, segment, progress, time left; at its end recording, model, summary and fit."""
    return context.runner.document(tests.find(context, test_id))


@router.post("/{test_id}/enough", **describe_answer(Extended))
async def enough(context: Ctx, principal: Tester, test_id: str) -> dict[str, Any]:
    """End a running adaptive, passive or moving test well, at the next pulse: what was measured is used."""
    row = await asyncio.to_thread(tests.find, context, test_id)
    return (await context.runner.enough(row, principal.name)).model_dump()


@router.websocket("/{test_id}/live")
async def live(socket: WebSocket, context: Ctx, test_id: str) -> None:
    """Live signals: `history` first, then `live` about 20 a second, `state`, `link`, and `test` at every turn.

    The socket closes (1000) once the test has ended and its last `test` message was sent; after a `problem` with 4000
    and its status: 4401 within two seconds once its session or token is no longer valid, 4403, 4404.
    """
    await socket.accept()
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        try:
            principal = await asyncio.to_thread(_admit, socket, context)
            row = await asyncio.to_thread(tests.find, context, test_id)
            await _watch(socket, context, row, by_key=principal.participant is not None)
        except ApiError as error:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(GOODBYE_S):
                    await socket.send_json({"type": "problem", "problem": error.body(socket.url.path)})
                    await socket.close(4000 + error.status, error.title)


def _admit(socket: WebSocket, context: Context) -> Principal:
    """Return who watches; a live view of a running test keeps the session from ending as idle.

    Raises ApiError: 401 no valid token or session; 403 without the scope, or from another site's page.
    """
    principal = context.auth.identify(socket, bound=True)
    refuse_outside(context.versions, principal, "WS", socket.url.path)
    if not principal.may(Scope.READ_LIVE):
        raise forbidden(f"This needs the scope {Scope.READ_LIVE}.")
    if principal.csrf is not None:
        same_origin(socket)
    if principal.page_session is not None:
        context.auth.record_action(principal.page_session)
    return principal


async def _watch(socket: WebSocket, context: Context, row: Test, by_key: bool) -> None:
    """Send until the test has ended or the page has gone. Raises ApiError once who watches no longer may."""
    queue = context.runner.hub.open()
    works = _send(socket, context, row, queue, by_key), _until_gone(socket), _until_refused(socket, context)
    tasks = [asyncio.create_task(work) for work in works]
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in reversed(tasks):  # why it ends early comes first
            if task in ended:
                task.result()
        if tasks[0] in ended:
            await socket.close()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        context.runner.hub.close(queue)


async def _send(
    socket: WebSocket, context: Context, row: Test, queue: asyncio.Queue[dict[str, Any]], by_key: bool
) -> None:
    history = queue.get_nowait()
    if history["test_id"] == row.id:
        await socket.send_json(history)
    document = await asyncio.to_thread(lambda: context.runner.document(tests.find(context, row.id)))
    await socket.send_json(_test_message(document))
    while not document["done"]:
        message = await _next(queue) or {"type": "idle", "rig_connected": context.rig.connected}
        kind = message["type"]
        if kind == "test":
            if message["test"]["id"] != row.id:
                continue
            document, message = message["test"], _test_message(message["test"])
        elif kind in ("live", "adaptive", "joint"):
            if message["test_id"] != row.id:
                continue
            if kind == "joint":  # what is still to be done, in words
                message = {**message, "words": missing_words((message["coverage"] or {}).get("missing"))}
        elif kind == "state" and by_key and message["rig"]["test_id"] != row.id:
            continue  # the rig is with somebody else, or says why it stopped then
        await socket.send_json(message)


def _test_message(document: dict[str, Any]) -> dict[str, Any]:
    """Return the message of how a test stands; `words`: what a page shows of it."""
    work = (document["identification"] or {}).get("text") or ""
    return {"type": "test", "test": document, "words": {"reason": document["reason"], "work": work}}


async def _next(queue: asyncio.Queue[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the next message; None after a second without one.

    Not by `asyncio.wait_for`, which in Python 3.11 may lose a cancellation: the channel then stayed open.
    """
    try:
        async with asyncio.timeout(1.0):
            return await queue.get()
    except TimeoutError:
        return None


async def _until_gone(socket: WebSocket) -> None:
    with contextlib.suppress(RuntimeError):
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass


async def _until_refused(socket: WebSocket, context: Context) -> None:
    """Check again and again whether who watches still may: not after the end of the session or a revoked token."""
    while True:
        await asyncio.sleep(LOOK_S)
        try:
            await asyncio.to_thread(_admit, socket, context)
        except SQLAlchemyError:  # a database that is busy or gone has refused nobody
            log.warning("whether a live channel is still allowed could not be read")
