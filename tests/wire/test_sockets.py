"""The rig's sockets on the wire: nothing that others ask, and nobody who only holds a connection, keeps out a stop."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig.messages import stop_socket
from tests.harness.processes import Bench, RigClient, default_plan
from tests.wire.test_rig import start

pytestmark = pytest.mark.wire


def test_two_rigs_cannot_share_the_data_or_the_port(shared: tuple[Bench, RigClient]):
    bench, client = shared
    with pytest.raises(RuntimeError, match="another rig"):
        bench.start_rig()
    assert client.status()["state"] == "ready"  # the first is none the worse for it


LONGEST = [{"name": "x", "sequence": "multilevel", "settings": {"duration_s": 75.0, "min_hold_s": 0.02}}] * 4


@contextlib.contextmanager
def half_open(path: Path, number: int) -> Iterator[list[socket.socket]]:
    """Connections on which half a request was sent; some of them the rig may have closed."""
    held = []
    for _ in range(number):
        held.append(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        held[-1].connect(str(path))
        with contextlib.suppress(OSError):
            held[-1].sendall(b'{"kind": "stop", "id"')
    try:
        yield held
    finally:
        for connection in held:
            connection.close()


def wait_until(met: Callable[[], bool]) -> None:
    """Or fail, after a time that only a machine that hangs takes."""
    end = time.monotonic() + 120
    while not met():
        assert time.monotonic() < end
        time.sleep(0.01)


def stop_apart(bench: Bench) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(60)
        connection.connect(str(stop_socket(bench.socket)))
        connection.sendall(b'{"kind": "stop", "id": 5, "reason": "choked", "by": "test"}\n')
        return json.loads(connection.makefile("rb").readline())


def answer_to(bench: Bench, line: str) -> dict[str, Any]:
    raw = bench.client()
    replies = raw._replies[0] = type(raw.events)()
    raw.send_raw(line)
    return replies.get(timeout=60)


def test_a_stop_is_heard_past_previews_and_1200_half_open_connections(shared: tuple[Bench, RigClient]):
    bench, client = shared
    start(bench, client, "choke")
    assert bench.rig is not None
    threads = [int(thread.name) for thread in Path(f"/proc/{bench.rig.popen.pid}/task").iterdir()]
    ranks = [os.sched_getscheduler(thread) for thread in threads]
    if ranks[threads.index(bench.rig.popen.pid)] == os.SCHED_RR:  # where a process may run before all others
        assert ranks.count(os.SCHED_FIFO) == 1  # who sends its pulses
    preview = json.dumps({"kind": "preview", "id": 9, "plan": default_plan("p", segments=LONGEST)})
    with half_open(bench.socket, 600), half_open(stop_socket(bench.socket), 600):
        for _ in range(4):
            asker = bench.client()
            asker._replies[9] = type(asker.events)()
            asker.send_raw(preview)
        reply = stop_apart(bench)
    assert reply["ok"]
    assert reply["id"] == 5
    assert reply["body"]["confirmed"], reply
    assert client.wait_state("latched")["reason"]


def test_a_newcomer_gets_in_past_those_who_say_nothing(shared: tuple[Bench, RigClient]):
    bench, client = shared
    assert client.status()["state"] == "ready"
    with half_open(bench.socket, 300) as held:
        assert bench.client().status()["state"] == "ready"
        held[0].setblocking(False)

        def let_go() -> bool:
            with half_open(bench.socket, 1), contextlib.suppress(BlockingIOError, ConnectionResetError):
                return held[0].recv(1) == b""
            return False

        wait_until(let_go)  # the one that was still for longest, once somebody else comes
    assert client.status()["state"] == "ready"  # one that speaks is kept


def test_what_is_malformed_or_too_much_at_once_is_refused_in_words(shared: tuple[Bench, RigClient]):
    bench, client = shared
    for line in ("not json", '{"kind": "dance"}', '{"kind": "start", "plan": {"test_id": 5}}', "[]"):
        reply = answer_to(bench, line)
        assert not reply["ok"] and reply["problem"]["detail"]
    long = json.dumps({"id": 7, "kind": "start", "plan": default_plan("x", kind="x" * 70_000)})
    assert "begin with its kind and its id" in answer_to(bench, long)["problem"]["detail"]
    raw = bench.client()
    raw._replies[0] = type(raw.events)()
    with contextlib.suppress(OSError):  # let go before all of it was sent
        raw.send_raw("x" * 2_500_000)
    assert raw.closed.wait(60)
    assert client.ask("preview", plan={"test_id": 5})["problem"]["code"] == "bad-plan"
    assert client.ask("preview", plan=default_plan("p"))["body"]["duration_s"] == pytest.approx(38.7)
    assert client.status()["state"] == "ready"
