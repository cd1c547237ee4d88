"""The rig's sockets without a rig: whatever comes to them."""

from __future__ import annotations

import asyncio
import json
import socket
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.rig import __main__ as program
from stimrig.rig.adapters.server import LONG_LINE_BYTES, Server
from stimrig.rig.adapters.stop_server import MAX_LINE_BYTES, UNREADABLE, StopServer
from stimrig.rig.control.replies import refusal, to_line
from stimrig.rig.messages import Reply, StateEvent, Status, StopEvidence
from stimrig.rig.phase import Phase
from stimrig.rig.requests import LONGEST_LINE
from tests.rig.live import LiveRig

READY = Status(state="ready")
PLAN = {"test_id": "t", "participant": "P", "profile": {"current_ma": 20.0}}


@pytest.mark.parametrize("leaves", [True, False])
def test_who_left_before_the_answer_is_told_nothing_more(tmp_path: Path, leaves: bool) -> None:
    async def subscribers_later() -> int:
        server, asked = Server(), list[Future[Any]]()
        server.rig = SimpleNamespace()

        def ask(_: object) -> Future[Any]:
            asked.append(Future())
            return asked[-1]

        server._submit = ask
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
            server._send_all(line := to_line(StateEvent(status=READY)), line)
            found = len(server._subscribers)
            writer.close()
            return found

    assert asyncio.run(subscribers_later()) == (0 if leaves else 1)


@pytest.mark.parametrize(
    ("line", "stops"),
    [
        (b'{"kind": "stop", "id": 7, "reason": "ouch"}\n', "ouch"),
        (b'{"kind": "stop", "id": 7}\n', UNREADABLE),
        (b'{"kind": "stop", "id": 7, "reason": "ouch", "of a newer service": 1}\n', UNREADABLE),
        (b"stop\n", UNREADABLE),
        (b"s" * 2 * MAX_LINE_BYTES + b"\n", UNREADABLE),
        (b'{"kind": "stop", "id": 7, "reason": "cut o', None),
    ],
)
def test_whatever_comes_to_the_door_for_stops_stops(tmp_path: Path, line: bytes, stops: str | None) -> None:
    asked: list[str] = []

    def stop(reason: str, _by: str) -> Future[StopEvidence]:
        asked.append(reason)
        future: Future[StopEvidence] = Future()
        future.set_result(StopEvidence(confirmed=True, detail="fallen"))
        return future

    server = StopServer(stop)
    server.open(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(str(tmp_path / "s"))
        connection.sendall(line)
        connection.shutdown(socket.SHUT_WR)
        reply = connection.makefile("rb").readline()
    server.close()
    assert asked == ([] if stops is None else [stops])
    assert bool(reply) is (stops is not None) and (not reply or json.loads(reply)["body"]["confirmed"])


@pytest.mark.parametrize(("phase", "answer"), [(Phase("ready"), "internal"), (Phase("running"), "busy")])
def test_a_long_plan_is_parsed_beside_no_test_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: Phase, answer: str
) -> None:
    """Who asks is answered in any case; `internal` says here that the rig was asked."""
    monkeypatch.setattr("stimrig.rig.adapters.server.obey", lambda _, asked: refusal(asked.id, ValueError()))
    rig = LiveRig(tmp_path, monkeypatch).rig
    rig.state.phase = phase
    widths = {"name": "s", "sequence": "widths", "settings": {"pulse_width_us": [100.25] * 10_000}}
    line = json.dumps({"kind": "start", "id": 7, "plan": {**PLAN, "segments": [widths]}}).encode() + b"\n"

    def ask(do: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(do())
        return done

    async def asked() -> dict[str, Any]:
        server = Server()
        server.rig, server._submit = rig, ask
        async with await asyncio.start_unix_server(server._serve, tmp_path / "t", limit=LONGEST_LINE):
            reader, writer = await asyncio.open_unix_connection(tmp_path / "t", limit=LONGEST_LINE)
            writer.write(line)
            async with asyncio.timeout(20.0):
                reply = json.loads(await reader.readline())
            writer.close()
            return reply

    assert len(line) > LONG_LINE_BYTES
    reply = asyncio.run(asked())
    assert (reply["id"], reply["ok"], reply["problem"]["code"]) == (7, False, answer)


def test_a_rig_whose_thread_hangs_is_in_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "HUNG_S", 0.05)
    hangs: Any = lambda _: Future()  # noqa: E731
    found = asyncio.run(program._trouble(None, hangs))
    assert found == "the rig's thread hangs: no answer for 0.05 s"
