"""Paced time goes on with real time, and waits for a process that is left without a processor, for nothing else."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.harness.paced_time.conductor import AHEAD_S, LATE_S, LOST_S, WAITED, Conductor, processor_ns, state_of
from tests.harness.paced_time.paced_clock import BYTES, FIRST_MEMBER, VARIABLE, PacedClock, real_ns, real_s, real_sleep

TICK_NS = 3_000_000
ASLEEP = "import time; print(flush=True); time.sleep(60)"
BUSY = "print(flush=True)\nwhile True: pass"


class World:
    """A conductor whose ticks a test gives, and what a reader reads."""

    def __init__(self, folder: Path) -> None:
        path = folder / "paced"
        path.write_bytes(bytes(BYTES))
        self.clock = PacedClock()
        self.clock.follow(str(path))
        self.conductor = Conductor(str(path))
        self.now_ns = real_ns()
        self.conductor.begin(self.now_ns)

    def paced_s(self) -> float:
        cells = self.clock.cells
        return cells[1 + 3 * (cells[0] % 64)] * 1e-9

    def heard(self, pid: int) -> None:
        self.clock.cells[FIRST_MEMBER], self.clock.cells[FIRST_MEMBER + 1] = pid, self.now_ns

    def goes_on(self, duration_s: float, each: Callable[[], None] = lambda: None) -> float:
        """How much paced time goes by in so much real time."""
        before_s = self.paced_s()
        for _ in range(int(duration_s * 1e9 / TICK_NS)):
            self.now_ns += TICK_NS
            each()
            self.conductor.tick(self.now_ns)
        return self.paced_s() - before_s


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


@pytest.fixture
def child() -> Iterator[Callable[[str], subprocess.Popen[bytes]]]:
    begun: list[subprocess.Popen[bytes]] = []

    def begin(code: str) -> subprocess.Popen[bytes]:
        environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment)
        begun.append(process)
        assert process.stdout is not None
        process.stdout.readline()
        return process

    yield begin
    for process in begun:
        process.kill()
        process.communicate()


def test_it_goes_on_with_real_time_while_all_are_heard(world: World, child: Callable[[str], subprocess.Popen[bytes]]):
    pid = child(ASLEEP).pid
    assert world.goes_on(0.6, lambda: world.heard(pid)) == pytest.approx(0.6, abs=1e-6)
    assert world.clock.cells[WAITED] == 0


def test_it_waits_for_one_that_is_not_heard_and_goes_on_then(
    world: World, child: Callable[[str], subprocess.Popen[bytes]]
):
    pid = child(ASLEEP).pid
    world.heard(pid)
    assert world.goes_on(0.6) <= LATE_S + AHEAD_S
    world.heard(pid)
    assert world.goes_on(0.3, lambda: world.heard(pid)) == pytest.approx(0.3, abs=0.01)
    assert world.clock.cells[WAITED] * 1e-9 == pytest.approx(0.6, abs=0.06)


def test_it_waits_while_its_conductor_gets_no_processor(world: World):
    before_s = world.paced_s()
    world.now_ns += 500_000_000
    world.conductor.tick(world.now_ns)
    assert world.paced_s() - before_s == pytest.approx(AHEAD_S)


def test_it_does_not_wait_for_one_that_is_stopped(world: World, child: Callable[[str], subprocess.Popen[bytes]]):
    process = child(ASLEEP)
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
    assert state_of(process.pid) in "Tt"
    world.heard(process.pid)
    assert world.goes_on(0.6) == pytest.approx(0.6, abs=1e-6)


def test_it_does_not_wait_for_one_that_has_ended(world: World, child: Callable[[str], subprocess.Popen[bytes]]):
    process = child(ASLEEP)
    world.heard(process.pid)
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert world.goes_on(0.6) == pytest.approx(0.6, abs=1e-6)
    assert world.clock.cells[FIRST_MEMBER] == 0


def test_it_does_not_wait_for_one_that_computes(world: World, child: Callable[[str], subprocess.Popen[bytes]]):
    """A rig that blocks itself is seen to."""
    process = child(BUSY)
    world.heard(process.pid)
    world.goes_on(0.003)
    before_ns = processor_ns(process.pid)
    while processor_ns(process.pid) - before_ns < 600_000_000:
        real_sleep(0.01)
    assert world.goes_on(0.6) == pytest.approx(0.6, abs=1e-6)


def test_it_does_not_wait_for_ever(world: World, child: Callable[[str], subprocess.Popen[bytes]]):
    world.heard(child(ASLEEP).pid)
    assert world.goes_on(LOST_S + 1.0) == pytest.approx(1.0, abs=0.1)


@pytest.mark.wire
def test_a_test_on_the_wire_its_children_and_their_waits_live_in_it():
    code = "import select, threading, time; print(time.monotonic, select.select, threading.Condition.wait.__module__)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "PacedClock.now_s" in told and "select_paced" in told and "paced_clock" in told
    code = "import time; print(time.monotonic())"
    before_s = time.monotonic()
    child_s = float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert before_s < child_s < time.monotonic() <= real_s()


@pytest.mark.wire
@pytest.mark.parametrize(
    "waits",
    [
        lambda: time.sleep(0.05),
        lambda: threading.Event().wait(0.05),
        lambda: select.select([], [], [], 0.05),
    ],
    ids=["sleep", "event", "select"],
)
def test_nothing_ends_before_its_paced_time(waits: Callable[[], object]):
    before_s = time.monotonic()
    waits()
    assert time.monotonic() - before_s >= 0.05


@pytest.mark.wire
def test_what_comes_is_not_waited_for_longer():
    event = threading.Event()
    threading.Timer(0.01, event.set).start()
    assert event.wait(60)
    read, write = os.pipe()
    os.write(write, b"x")
    assert select.select([read], [], [], 60)[0] == [read]
    os.close(read)
    os.close(write)
