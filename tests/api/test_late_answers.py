"""Answers that come late and in pieces say what they would have said at once."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.harness import late_answers
from tests.harness.late_answers import LateAnswers

BODY = bytes(range(256)) * 20


async def answer(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": BODY, "more_body": True})
    await send({"type": "http.response.body", "body": b"the end"})


def sent(agent: bytes) -> list[Any]:
    messages: list[Any] = []

    async def take(message: Any) -> None:
        messages.append(message)

    scope = {"type": "http", "headers": [(b"user-agent", agent)]}
    asyncio.run(LateAnswers(answer, seed=1)(scope, None, take))
    return messages


@pytest.mark.parametrize(("agent", "count"), [(b"Mozilla/5.0", 1 + late_answers.PIECES + 1), (b"python-httpx", 3)])
def test_the_same_bytes_in_the_same_order(monkeypatch: pytest.MonkeyPatch, agent: bytes, count: int) -> None:
    monkeypatch.setattr(late_answers, "LATEST_S", 0.01)
    messages = sent(agent)
    assert [message["type"] for message in messages] == ["http.response.start"] + (count - 1) * ["http.response.body"]
    assert b"".join(message.get("body", b"") for message in messages) == BODY + b"the end"
    assert [message.get("more_body", False) for message in messages[1:]] == (count - 2) * [True] + [False]
