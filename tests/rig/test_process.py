"""The rig's process: a key in its terminal stops, and systemd hears that it is ready, alive, stopping."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import select
import socket
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from stimrig.rig import __main__ as program
from stimrig.rig import config
from stimrig.rig.__main__ import Notifier
from stimrig.rig.control import pair
from stimrig.rig.control.rig import Rig
from stimrig.rig.keys import StopKey, in_front
from tests.rig.fakes import FakeCell, FakeStimulator
from tests.rig.live import LINE, LiveRig
from tests.simulator.virtual_time import VirtualClock

ROOT = Path(__file__).parents[2]
PATIENCE_S = 30.0
CHILD = """
import threading
from stimrig.rig.keys import StopKey
pressed = threading.Event()
with StopKey(pressed.set) as key:
    print("watching" if key.watched else "blind", flush=True)
    pressed.wait(20)
print("stopped" if pressed.is_set() else "lost", flush=True)
"""


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    ends = os.openpty()
    yield ends
    for fd in ends:
        os.close(fd)


def soon(true: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def test_one_key_is_one_stop_and_the_terminal_is_given_back(terminal: tuple[int, int]):
    person, ours = terminal
    before, pressed, earlier = termios.tcgetattr(ours), list[int](), set(threading.enumerate())
    with StopKey(lambda: pressed.append(1), ours, lambda _: True) as key:
        assert key.watched
        assert not termios.tcgetattr(ours)[3] & (termios.ICANON | termios.ECHO)
        assert termios.tcgetattr(ours)[3] & termios.ISIG  # Ctrl-C is a signal as ever
        for n, keys in enumerate((b" ", b"\x1b[A"), start=1):
            os.write(person, keys)
            soon(lambda n=n: len(pressed) == n)
        assert not select.select([ours], [], [], 0)[0], "an arrow is one key"
    assert termios.tcgetattr(ours) == before and len(pressed) == 2
    assert "stop key" not in {thread.name for thread in set(threading.enumerate()) - earlier}, "nobody reads any more"


def test_without_a_terminal_of_its_own_or_in_the_background_nothing_is_read(terminal: tuple[int, int]):
    read, write = os.pipe()
    os.write(write, b"x")
    for fd in (terminal[1], read):  # a terminal that is not this process's, and none
        assert not in_front(fd)
        with StopKey(lambda: pytest.fail("not meant for us"), fd) as key:
            assert not key.watched
    assert os.read(read, 1) == b"x"
    os.close(read)
    os.close(write)
    front, asked = [True], list[int]()
    with StopKey(lambda: pytest.fail("not ours"), terminal[1], lambda _: asked.append(1) or front[0]):
        front[0] = False
        os.write(terminal[0], b" \n")
        soon(lambda: len(asked) > 1)
    assert select.select([terminal[1]], [], [], 0)[0], "the keys are for another process"


def test_in_a_real_terminal():
    pid, master = pty.fork()
    if pid == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", CHILD])
    said, end_s = b"", time.monotonic() + PATIENCE_S
    while b"stopped" not in said and time.monotonic() < end_s:
        if not select.select([master], [], [], 0.2)[0]:
            continue
        try:
            said += os.read(master, 1024)
        except OSError:
            break
        if b"watching" in said and b"stopped" not in said:
            os.write(master, b"s")
    os.waitpid(pid, 0)
    os.close(master)
    assert b"watching" in said
    assert b"stopped" in said


def test_the_rig_stops_by_it_and_latches(live: LiveRig):
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(5)
    live.ask(program._stop_by_key(live.rig))
    sent = len(live.stimulator.sent)
    assert live.wait("latched") == "a key in the terminal (by operator)"
    live.machine.wait(1.0)
    assert len(live.stimulator.sent) == sent == 5


@pytest.fixture
def manager() -> Iterator[socket.socket]:
    """A service manager's end of the line; a socket's path must be short."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(f"{folder}/notify")
        line.setblocking(False)
        yield line


def heard(line: socket.socket) -> list[str]:
    words = []
    while True:
        try:
            words.append(line.recv(4096).decode())
        except BlockingIOError:
            return words


def test_the_watchdog_is_fed_by_proof_alone(manager: socket.socket):
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "30000000"})
    notifier.ready()
    notifier.alive(None)
    notifier.alive("the sender hangs")
    notifier.alive("the sender hangs")
    notifier.alive(None)
    notifier.stopping()
    assert heard(manager) == [
        "READY=1", "WATCHDOG=1", "STATUS=not fed: the sender hangs", "STATUS=", "WATCHDOG=1", "STOPPING=1",
    ]  # fmt: skip


def test_without_a_watchdog_of_its_own_or_a_manager_nothing_is_fed(manager: socket.socket):
    for watchdog in ({}, {"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"}):
        notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname(), **watchdog})
        notifier.ready()
        notifier.alive(None)
        assert heard(manager) == ["READY=1"]
    for address in ("", "/nowhere/at/all", "@nobody-listens-here"):
        notifier = Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000000"})
        notifier.ready()
        notifier.alive(None)
        notifier.alive("trouble")


def test_an_abstract_socket_is_found():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(f"\0stimrig-test-{os.getpid()}")
        line.setblocking(False)
        Notifier({"NOTIFY_SOCKET": f"@stimrig-test-{os.getpid()}"}).ready()
        assert heard(line) == ["READY=1"]


@pytest.mark.parametrize("well", [True, False])
def test_the_process_tells_what_it_finds(
    manager: socket.socket,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    well: bool,
    capsys: pytest.CaptureFixture[str],
):
    """The program itself on this machine, with devices in this process, until its parent has died."""
    stimulator = FakeStimulator(VirtualClock())
    made = {"stimulator": stimulator, "load_cell": FakeCell(stimulator.clock, stimulator)}
    found = SimpleNamespace(find=lambda kind, _: SimpleNamespace(create=lambda _settings, _machine: made[kind]))
    monkeypatch.setattr(pair, "devices", found)
    beats = iter(range(4))
    monkeypatch.setattr(program.os, "sched_setscheduler", lambda *_: None)
    monkeypatch.setattr(program.os, "getppid", lambda: 0 if next(beats, None) is not None else 1)
    monkeypatch.setattr(program, "BEAT_PERIOD_S", 0.01)
    monkeypatch.setenv("NOTIFY_SOCKET", manager.getsockname())
    monkeypatch.setenv("WATCHDOG_USEC", "30000000")
    if not well:
        monkeypatch.setattr(Rig, "trouble", lambda _: "the sender hangs")
    interval_s = sys.getswitchinterval()
    try:
        place = Path(manager.getsockname()).parent / "rig.sock"
        chosen = config.for_emulator(json.dumps(LINE), data_dir=tmp_path / "data", socket=place)
        asyncio.run(program._serve(chosen, 0))
    finally:
        sys.setswitchinterval(interval_s)
    fed = ["WATCHDOG=1"] * 4 if well else ["STATUS=not fed: the sender hangs"]
    assert heard(manager) == ["READY=1", *fed, "STOPPING=1"]
    assert '"state": "ready"' in capsys.readouterr().out
