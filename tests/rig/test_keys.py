"""A key in the terminal stops; nothing else of the terminal is touched."""

from __future__ import annotations

import asyncio
import os
import pty
import select
import sys
import termios
import time
from pathlib import Path

import pytest

from rig import __main__ as program
from rig.keys import StopKey, in_front
from tests.rig.live import LiveRig

ROOT = Path(__file__).parents[2]
CHILD = """
import asyncio, sys
from rig.keys import StopKey
async def main():
    pressed = asyncio.Event()
    with StopKey(asyncio.get_running_loop(), pressed.set) as key:
        print("watching" if key.watched else "blind", flush=True)
        await asyncio.wait_for(pressed.wait(), 20)
    print("stopped", flush=True)
asyncio.run(main())
"""


def test_one_key_is_one_stop_and_the_terminal_is_given_back():
    master, slave = os.openpty()
    before = termios.tcgetattr(slave)
    pressed = []

    async def press() -> None:
        with StopKey(asyncio.get_running_loop(), lambda: pressed.append(1), slave, lambda _: True) as key:
            assert key.watched
            assert not termios.tcgetattr(slave)[3] & (termios.ICANON | termios.ECHO)
            assert termios.tcgetattr(slave)[3] & termios.ISIG  # Ctrl-C is a signal as ever
            for keys in (b" ", b"\x1b[A"):
                os.write(master, keys)
                await asyncio.sleep(0.05)

    asyncio.run(press())
    assert len(pressed) == 2
    assert termios.tcgetattr(slave) == before
    os.close(slave)
    os.close(master)


def test_without_a_terminal_of_its_own_nothing_is_read():
    master, slave = os.openpty()  # a terminal, and not this process's
    read, write = os.pipe()
    os.write(write, b"x")

    async def look() -> None:
        for fd in (slave, read):
            assert not in_front(fd)
            with StopKey(asyncio.get_running_loop(), lambda: pytest.fail("not meant for us"), fd) as key:
                assert not key.watched
                await asyncio.sleep(0.02)

    asyncio.run(look())
    assert os.read(read, 1) == b"x"
    for fd in (master, slave, read, write):
        os.close(fd)


def test_moved_to_the_background_it_lets_go():
    master, slave = os.openpty()
    front = [True]

    async def press() -> None:
        with StopKey(asyncio.get_running_loop(), lambda: pytest.fail("not ours"), slave, lambda _: front[0]):
            front[0] = False
            os.write(master, b" \n")
            await asyncio.sleep(0.05)

    asyncio.run(press())
    os.close(slave)
    os.close(master)


def test_in_a_real_terminal():
    pid, master = pty.fork()
    if pid == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", CHILD])
    said, end_s = b"", time.monotonic() + 30
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


def test_the_rig_stops_by_it_and_latches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    live = LiveRig(tmp_path, monkeypatch)
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(5)
    sent = len(live.stimulator.sent)
    live.ask(program._stop_by_key(live.rig))
    assert live.wait("latched") == "a key in the terminal (by operator)"
    assert len(live.stimulator.sent) == sent
    live.close()
