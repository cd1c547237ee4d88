"""The rig's socket without a rig: who is told what happens, and who no longer."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from rig.control.server import Server
from rig.messages import StateEvent, Status


class Slow:
    """Answers a subscription only when it is let."""

    def __init__(self) -> None:
        self.let = asyncio.Event()
        self.loop = asyncio.get_running_loop()

    def status(self) -> Status:
        if (
            threading.current_thread() is not threading.main_thread()
        ):  # the request's thread; the event loop is not kept
            asyncio.run_coroutine_threadsafe(self.let.wait(), self.loop).result(10.0)
        return Status(state="ready")


@pytest.mark.parametrize("leaves", [True, False])
def test_who_left_before_the_answer_is_told_nothing_more(tmp_path: Path, leaves: bool) -> None:
    async def subscribers_later() -> int:
        server, rig = Server(), Slow()
        server.rig = SimpleNamespace(status=rig.status)  # pyright: ignore[reportAttributeAccessIssue]
        async with await asyncio.start_unix_server(server._serve, tmp_path / "s"):
            _, writer = await asyncio.open_unix_connection(tmp_path / "s")
            writer.write(json.dumps({"kind": "subscribe", "id": 1}).encode() + b"\n")
            await writer.drain()
            async with asyncio.timeout(10.0):
                while not server._tasks:
                    await asyncio.sleep(0.01)
                if leaves:
                    writer.close()
                    await writer.wait_closed()
                rig.let.set()
                while server._tasks:
                    await asyncio.sleep(0.01)
                await asyncio.sleep(0.1)
            server._send_all(StateEvent(status=Status(state="ready")))
            found = len(server._subscribers)
            writer.close()
            return found

    assert asyncio.run(subscribers_later()) == (0 if leaves else 1)
