"""A key in the terminal stops; nothing else of the terminal is touched."""

from __future__ import annotations

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
    """A person's end, and the program's."""
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
    before, pressed = termios.tcgetattr(ours), list[int]()
    with StopKey(lambda: pressed.append(1), ours, lambda _: True) as key:
        assert key.watched
        assert not termios.tcgetattr(ours)[3] & (termios.ICANON | termios.ECHO)
        assert termios.tcgetattr(ours)[3] & termios.ISIG  # Ctrl-C is a signal as ever
        for n, keys in enumerate((b" ", b"\x1b[A"), start=1):  # an arrow is one key
            os.write(person, keys)
            soon(lambda n=n: len(pressed) == n)
    assert termios.tcgetattr(ours) == before and len(pressed) == 2


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


def test_the_rig_stops_by_it_and_latches(make: Callable[..., LiveRig]):
    live = make()
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(5)
    live.ask(program._stop_by_key(live.rig))
    sent = len(live.stimulator.sent)
    assert live.wait("latched") == "a key in the terminal (by operator)"
    live.machine.wait(1.0)
    assert len(live.stimulator.sent) == sent == 5
