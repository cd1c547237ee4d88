"""What systemd hears: ready, alive while there is proof of it, stopping."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from stimrig.rig import __main__ as program
from stimrig.rig import config
from stimrig.rig.control import pair
from stimrig.rig.control.rig import Rig
from stimrig.rig.notify import Notifier
from tests.rig.fakes import FakeCell, FakeStimulator
from tests.rig.live import LINE
from tests.simulator.virtual_time import VirtualClock


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


@pytest.mark.parametrize("watchdog", [{}, {"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"}])
def test_without_a_watchdog_of_its_own_there_is_nothing_to_feed(manager: socket.socket, watchdog: dict[str, str]):
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname(), **watchdog})
    notifier.ready()
    notifier.alive(None)
    assert heard(manager) == ["READY=1"]


@pytest.mark.parametrize("address", ["", "/nowhere/at/all", "@nobody-listens-here"])
def test_without_a_manager_nothing_happens(address: str):
    notifier = Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000000"})
    notifier.ready()
    notifier.alive(None)
    notifier.alive("trouble")
    notifier.stopping()


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
