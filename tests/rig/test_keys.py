"""A key in the terminal stops; nothing else of the terminal is touched."""

from __future__ import annotations

import asyncio
import os
import pty
import select
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from stimrig.rig import __main__ as program
from stimrig.rig.keys import StopKey, in_front
from tests.rig.live import LiveRig

ROOT = Path(__file__).parents[2]
PATIENCE_S = 30.0
CHILD = """
import asyncio, sys
from stimrig.rig.keys import StopKey
async def main():
    pressed = asyncio.Event()
    with StopKey(asyncio.get_running_loop(), pressed.set) as key:
        print("watching" if key.watched else "blind", flush=True)
        await asyncio.wait_for(pressed.wait(), 20)
    print("stopped", flush=True)
asyncio.run(main())
"""


class Loop(asyncio.AbstractEventLoop):
    """One that reads when the test says so."""

    def __init__(self) -> None:
        self.readers: dict[object, Callable[[], object]] = {}

    def add_reader(self, fd, callback, *_):  # pyright: ignore
        self.readers[fd] = callback

    def remove_reader(self, fd):  # pyright: ignore
        return self.readers.pop(fd, None) is not None

    def read(self, fd: int) -> None:
        """Once something is there."""
        assert select.select([fd], [], [], PATIENCE_S)[0]
        self.readers[fd]()


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """A person's end, and the program's."""
    ends = os.openpty()
    yield ends
    for fd in ends:
        os.close(fd)


def test_one_key_is_one_stop_and_the_terminal_is_given_back(terminal: tuple[int, int]):
    person, ours = terminal
    before, loop, pressed = termios.tcgetattr(ours), Loop(), list[int]()
    with StopKey(loop, lambda: pressed.append(1), ours, lambda _: True) as key:
        assert key.watched
        assert not termios.tcgetattr(ours)[3] & (termios.ICANON | termios.ECHO)
        assert termios.tcgetattr(ours)[3] & termios.ISIG  # Ctrl-C is a signal as ever
        for n, keys in enumerate((b" ", b"\x1b[A"), start=1):
            os.write(person, keys)
            loop.read(ours)
            assert len(pressed) == n
        assert not select.select([ours], [], [], 0)[0], "an arrow is one key"
    assert termios.tcgetattr(ours) == before
    assert loop.readers == {}


def test_without_a_terminal_of_its_own_nothing_is_read(terminal: tuple[int, int]):
    read, write = os.pipe()
    os.write(write, b"x")
    for fd in (terminal[1], read):  # a terminal that is not this process's, and none
        assert not in_front(fd)
        loop = Loop()
        with StopKey(loop, lambda: pytest.fail("not meant for us"), fd) as key:
            assert not key.watched
            assert loop.readers == {}
    assert os.read(read, 1) == b"x"
    os.close(read)
    os.close(write)


def test_moved_to_the_background_it_lets_go(terminal: tuple[int, int]):
    person, ours = terminal
    front, loop = [True], Loop()
    with StopKey(loop, lambda: pytest.fail("not ours"), ours, lambda _: front[0]):
        front[0] = False
        os.write(person, b" \n")
        loop.read(ours)
        assert loop.readers == {}


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


def test_the_rig_stops_by_it_and_latches(make: Callable[..., LiveRig]):
    live = make()
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(5)
    live.ask(program._stop_by_key(live.rig))
    sent = len(live.stimulator.sent)
    assert live.wait("latched") == "a key in the terminal (by operator)"
    live.machine.wait(1.0)
    assert len(live.stimulator.sent) == sent == 5
