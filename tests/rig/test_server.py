"""The rig's sockets without a rig, and previews in a process of their own: bounded in time, memory and number."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.rig import __main__ as program
from stimrig.rig.adapters import builders
from stimrig.rig.adapters.builders import Previews
from stimrig.rig.adapters.server import LONG_LINE_BYTES, Server
from stimrig.rig.adapters.stop_server import MAX_LINE_BYTES, UNREADABLE, StopServer
from stimrig.rig.control.replies import internal_error, to_line
from stimrig.rig.errors import BusyError
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.messages import Reply, StateEvent, Status, StopEvidence
from stimrig.rig.phase import Phase
from stimrig.rig.requests import LONGEST_LINE
from tests.rig.live import LiveRig

READY = Status(state="ready")


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
    monkeypatch.setattr("stimrig.rig.adapters.server.obey", lambda _, asked: internal_error(asked.id, ValueError()))
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


ROOT = Path(__file__).parents[2]
PLAN = {"test_id": "t", "participant": "P", "profile": {"current_ma": 20.0}}
REQUEST = json.dumps({"kind": "preview", "id": 3, "plan": PLAN}).encode() + b"\n"


@pytest.fixture
def previews(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Previews, Callable[[Any], Any]]]:
    """Previews that are closed in the end, and what runs a coroutine on their loop."""
    monkeypatch.chdir(ROOT)
    with asyncio.Runner() as runner:
        made = Previews(HARD_LIMITS, 1.0)
        yield made, runner.run
        runner.run(made.close())


Asked = tuple[Previews, Callable[[Any], Any]]


def test_one_that_takes_too_long_is_ended_and_the_next_is_built(previews: Asked, monkeypatch: pytest.MonkeyPatch):
    asked, run = previews
    run(asked.warm())
    first = asked._process
    monkeypatch.setattr(builders, "MAX_BUILD_S", 0.0)
    with pytest.raises(BusyError, match="not built within"):
        run(asked.reply(REQUEST))
    assert first is not None and first.returncode is not None
    monkeypatch.setattr(builders, "MAX_BUILD_S", 60.0)
    reply = json.loads(run(asked.reply(REQUEST)))
    assert (reply["id"], reply["ok"], reply["body"]["duration_s"]) == (3, True, pytest.approx(38.7))


def test_a_slow_start_is_not_part_of_a_requests_time(previews: Asked, monkeypatch: pytest.MonkeyPatch):
    asked, run = previews
    code = "import sys, time; time.sleep(2); print(flush=True); sys.stdin.readline(); print(sys.stdin.readline())"
    execute = asyncio.create_subprocess_exec
    slow = lambda *_, **options: execute(sys.executable, "-c", code, **options)  # noqa: E731
    monkeypatch.setattr(asyncio, "create_subprocess_exec", slow)
    monkeypatch.setattr(builders, "MAX_BUILD_S", 1.9)
    asked._first = b""
    assert run(asked.reply(REQUEST)) == REQUEST


def test_a_request_that_is_cancelled_while_its_builder_starts_leaves_no_reply_to_the_next(
    previews: Asked, monkeypatch: pytest.MonkeyPatch
):
    asked, run = previews
    execute, begun = asyncio.create_subprocess_exec, list[asyncio.subprocess.Process]()

    async def slow(*command: str, **options: Any) -> asyncio.subprocess.Process:
        code = "import time; time.sleep(60)"
        begun.append(await execute(*(command if begun else (sys.executable, "-c", code)), **options))
        return begun[-1]

    async def cancelled() -> None:
        first = asyncio.create_task(asked.reply(REQUEST))
        while not begun:
            await asyncio.sleep(0.01)
        first.cancel()
        await asyncio.gather(first, return_exceptions=True)
        assert first.cancelled()

    monkeypatch.setattr(asyncio, "create_subprocess_exec", slow)
    run(cancelled())
    assert json.loads(run(asked.reply(REQUEST)))["ok"]
    assert run(begun[0].wait()) < 0, "nobody waits for it any more"


def test_a_builder_that_does_not_start_is_given_up_and_started_again_when_needed(
    previews: Asked, monkeypatch: pytest.MonkeyPatch
):
    asked, run = previews
    monkeypatch.setattr(builders, "MAX_START_S", 0.0)
    run(asked.warm())
    assert asked._process is None
    monkeypatch.setattr(builders, "MAX_START_S", 60.0)
    assert json.loads(run(asked.reply(REQUEST)))["ok"]


def test_who_would_wait_for_too_long_is_refused_at_once(previews: Asked, monkeypatch: pytest.MonkeyPatch):
    asked, run = previews
    monkeypatch.setattr(builders, "MAX_BUILD_S", 60.0)

    async def many() -> list[Any]:
        return await asyncio.gather(*(asked.reply(REQUEST) for _ in range(40)), return_exceptions=True)

    found = run(many())
    assert [isinstance(one, bytes) for one in found[: builders.MAX_WAITING]] == [True] * builders.MAX_WAITING
    assert all(isinstance(one, BusyError) for one in found[builders.MAX_WAITING :])
    assert json.loads(run(asked.reply(REQUEST)))["ok"]


def test_memory_is_bounded():
    code = "import stimrig.rig.builder as b; b._modest(5); bytearray(2 << 30)"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert "MemoryError" in ended.stderr


def test_what_is_wrong_is_told_and_the_builder_lives_on(previews: Asked):
    asked, run = previews
    too_long = {**PLAN, "segments": [{"name": "x", "sequence": "prbs", "settings": {"chips": 100_000}}]}
    process = None
    for line in (b"{}", b"[[", b"\xff\xfe", json.dumps({"kind": "preview", "id": 10, "plan": too_long}).encode()):
        reply = json.loads(run(asked.reply(line + b"\n")))
        assert not reply["ok"]
        assert reply["problem"]["code"] in ("bad-plan", "refused")
        process = process or asked._process
    assert asked._process is process
    assert json.loads(run(asked.reply(REQUEST)))["ok"]


def test_a_range_is_judged_by_the_calibration_of_the_moment(previews: Asked):
    asked, run = previews
    asks = {"profile": {"angle_range_rad": [0.2, 2.0], "angle_set_at_utc": "first"}, "kind": "moving"}
    plan = {**PLAN, **asks, "angle": {"range_rad": [0.2, 2.0], "still_s": 2.0}}
    line = json.dumps({"kind": "preview", "id": 1, "plan": plan}).encode() + b"\n"
    for now, fine in (("first", True), ("second", False), (None, False), ("first", True)):
        reply = json.loads(run(asked.reply(line, now)))
        assert reply["ok"] is fine, reply
        assert fine or "say the range again" in reply["problem"]["detail"]
