"""The rig's socket without a rig: who is told what happens, and who no longer."""

from __future__ import annotations

import asyncio
import json
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig import __main__ as program
from rig.adapters.server import Server
from rig.messages import Reply, StateEvent, Status

READY = Status(state="ready")


@pytest.mark.parametrize("leaves", [True, False])
def test_who_left_before_the_answer_is_told_nothing_more(tmp_path: Path, leaves: bool) -> None:
    async def subscribers_later() -> int:
        server, asked = Server(), list[Future[Any]]()
        server.rig = SimpleNamespace()  # pyright: ignore[reportAttributeAccessIssue]

        def ask(_: object) -> Future[Any]:
            asked.append(Future())
            return asked[-1]

        server._ask = ask
        async with await asyncio.start_unix_server(server._serve, tmp_path / "s"), asyncio.timeout(10.0):
            _, writer = await asyncio.open_unix_connection(tmp_path / "s")
            writer.write(json.dumps({"kind": "subscribe", "id": 1}).encode() + b"\n")
            while not asked:
                await asyncio.sleep(0)
            if leaves:
                writer.close()
            while leaves and len(server._connections):
                await asyncio.sleep(0)
            asked[0].set_result(Reply(id=1, ok=True, body={}))
            while len(asked) < 2:
                await asyncio.sleep(0)
            asked[1].set_result(READY)
            while server._tasks or (leaves and not all(w.transport.is_closing() for w in server._subscribers)):
                await asyncio.sleep(0)
            server._send_all(StateEvent(status=READY))
            found = len(server._subscribers)
            writer.close()
            return found

    assert asyncio.run(subscribers_later()) == (0 if leaves else 1)


def test_a_rig_whose_thread_hangs_is_in_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "HUNG_S", 0.05)
    hangs: Any = lambda _: Future()  # noqa: E731
    found = asyncio.run(program._trouble(None, hangs))  # pyright: ignore[reportArgumentType]
    assert found == "the rig's thread hangs: no answer for 0.05 s"
