"""Nothing that others ask of the rig's socket, and nobody who only holds a connection, keeps out a stop."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig.messages import stop_socket
from tests.harness.processes import Bench, RigClient, alive, below, default_plan

pytestmark = pytest.mark.wire

HOLD = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 60.0, "off_s": 0.0, "repeats": 1}},
]
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


def rank_is_granted() -> bool:
    """Whether a child may run before all other processes."""
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60).returncode == 0


def ranks_of(bench: Bench) -> list[int]:
    """How each thread of the rig is scheduled."""
    assert bench.rig is not None
    threads = Path(f"/proc/{bench.rig.popen.pid}/task").iterdir()
    return [os.sched_getscheduler(int(thread.name)) for thread in threads]


def preview_again_and_again(bench: Bench, ended: threading.Event, codes: list[str]) -> None:
    client = bench.client()
    while not ended.is_set():
        reply = client.ask("preview", plan=default_plan("p", segments=LONGEST), timeout_s=60.0)
        codes.append("ok" if reply["ok"] else reply["problem"]["code"])
        ended.wait(0.0 if reply["ok"] else 0.2)


@pytest.mark.campaign  # what it does to the machine can end the test before the stop does
def test_a_stop_is_heard_under_forty_previews_and_1200_half_open_connections(make_bench: Callable[..., Bench]):
    bench = make_bench("--noise-seed", "7")
    client = bench.start_rig()
    ended, codes = threading.Event(), []
    assert client.start(default_plan("choke", segments=HOLD))["ok"]
    client.wait_state("running")
    if rank_is_granted():
        ranks = ranks_of(bench)
        assert ranks.count(os.SCHED_FIFO) == 1  # who sends its pulses
        assert set(ranks) == {os.SCHED_RR, os.SCHED_FIFO}
    askers = [threading.Thread(target=preview_again_and_again, args=(bench, ended, codes)) for _ in range(40)]
    with half_open(bench.socket, 600), half_open(stop_socket(bench.socket), 600):
        for asker in askers:
            asker.start()
        try:
            wait_until(lambda: codes.count("ok") >= 2 and "busy" in codes)
            reply = stop_apart(bench)
        finally:
            ended.set()
    for asker in askers:
        asker.join()
    assert reply["ok"]
    assert reply["id"] == 5
    assert reply["body"]["confirmed"], reply
    assert "ok" in codes and set(codes) <= {"ok", "busy"}, set(codes)
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


def test_a_builder_that_died_is_begun_anew(shared: tuple[Bench, RigClient]):
    bench, client = shared
    assert bench.rig is not None
    for _ in range(2):
        built = client.ask("preview", plan=default_plan("p", segments=LONGEST), timeout_s=60.0)
        assert built["ok"], built
        assert built["body"]["duration_s"] == 300.0
        children = below(bench.rig.popen.pid)
        (builder,) = (pid for pid in children if b"previews" in Path(f"/proc/{pid}/cmdline").read_bytes())
        assert os.sched_getscheduler(builder) == os.SCHED_OTHER
        os.kill(builder, signal.SIGKILL)
        wait_until(lambda gone=builder: not alive(gone))
        reply = client.ask("preview", plan=default_plan("p"), timeout_s=60.0)
        assert reply["ok"] or reply["problem"]["code"] == "bad-plan"


def test_what_is_too_much_at_once_is_refused_in_words(shared: tuple[Bench, RigClient]):
    bench, client = shared
    raw = bench.client()
    raw._replies[0] = client.events.__class__()
    raw.send_raw(json.dumps({"id": 7, "kind": "start", "plan": default_plan("x", kind="x" * 70_000)}))
    assert "begin with its kind and its id" in raw._replies[0].get(timeout=60)["problem"]["detail"]
    with contextlib.suppress(OSError):  # let go before all of it was sent
        raw.send_raw("x" * 2_500_000)
    assert raw.closed.wait(60)
    wrong = client.ask("preview", plan={"test_id": 5})
    assert wrong["problem"]["code"] == "bad-plan"
    assert client.status()["state"] == "ready"
