"""Paced time goes on with real time, and waits for a process that is left without a processor, for nothing else."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stimrig.rig.adapters.machine import PRIORITY
from tests.harness.paced_time import CLOCK, conductor
from tests.harness.paced_time.conductor import AHEAD_S, LATE_S, Conductor, states_of
from tests.harness.paced_time.paced_clock import (
    BYTES,
    FIRST_MEMBER,
    LOST_NS,
    PLACES,
    PacedClock,
    real_ns,
    real_s,
    select_paced,
)
from tests.harness.processes import ROOT, Bench

TICK_NS = 3_000_000
ASLEEP = "import time; print(flush=True); time.sleep(60)"
BUSY = "while True: pass"
RIG, ORDINARY = 2**22 + 1, 2**22 + 2
"""Numbers that no process has."""


class World:
    """A conductor whose ticks a test gives, one process that keeps time, and what a reader reads."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = folder / "paced"
        path.write_bytes(bytes(BYTES))
        self.clock = PacedClock()
        self.clock.follow(str(path))
        self.now_ns = real_ns()
        self.processors = {0: self.now_ns}
        self.conductor = Conductor(str(path), self.processors)
        self.conductor.begin(self.now_ns)
        self.states, self.used_share, self.other_share = {"S", "R"}, 0.0, 0.0
        monkeypatch.setattr(conductor, "states_of", lambda _: self.states)
        monkeypatch.setattr(conductor, "processor_ns", self.used_ns)
        monkeypatch.setattr(conductor, "runs_first", lambda pid: pid == RIG)
        self.runs()

    def used_ns(self, pid: int) -> int:
        """Processor time."""
        return int((self.used_share if pid == os.getpid() else self.other_share) * self.now_ns)

    def is_joined_by(self, pid: int, used_share: float) -> None:
        """Another process keeps time, and always runs."""
        self.other_share = used_share
        self.clock.cells[PLACES[1]], self.clock.cells[PLACES[1] + 1] = pid, self.now_ns + 60_000_000_000

    def runs(self) -> None:
        """The process says that it runs."""
        self.clock.cells[FIRST_MEMBER], self.clock.cells[FIRST_MEMBER + 1] = os.getpid(), self.now_ns

    def goes_on(self, duration_s: float, runs: bool = False, processor_runs: bool = True) -> float:
        """How much paced time goes by in so much real time. It never goes back, nor beyond what was promised."""
        before_ns = limit_ns = self.clock.read(self.now_ns)[0]
        for _ in range(int(duration_s * 1e9 / TICK_NS)):
            self.now_ns += TICK_NS
            if runs:
                self.runs()
            if processor_runs:
                self.processors[0] = self.now_ns
            seen_ns = self.clock.read(self.now_ns)[0]
            assert seen_ns >= limit_ns
            limit_ns = seen_ns
            self.conductor.tick(self.now_ns - TICK_NS // 3)  # it looked a little before it wrote
        return (self.clock.read(self.now_ns)[0] - before_ns) * 1e-9


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    return World(tmp_path, monkeypatch)


def test_it_goes_on_with_real_time_while_all_run(world: World):
    assert world.goes_on(0.6, runs=True) == pytest.approx(0.6, abs=1e-6)
    assert world.clock.waited_ns(world.now_ns) == 0


def test_it_waits_for_one_that_is_ready_to_run_and_does_not_and_goes_on_then(world: World):
    assert world.goes_on(0.6) <= LATE_S + AHEAD_S
    assert world.goes_on(0.3, runs=True) == pytest.approx(0.3, abs=0.01)
    assert world.clock.waited_ns(world.now_ns) * 1e-9 == pytest.approx(0.6, abs=0.06)


def test_it_waits_for_a_processor_that_its_host_took_away(world: World):
    assert world.goes_on(0.6, runs=True, processor_runs=False) <= LATE_S + AHEAD_S


def test_it_waits_while_its_conductor_gets_no_processor(world: World):
    before_ns = world.clock.read(world.now_ns)[0]
    assert world.clock.read(world.now_ns + 500_000_000)[0] - before_ns == int(AHEAD_S * 1e9)


@pytest.mark.parametrize(
    ("states", "used_share"),
    [({"T"}, 0.0), ({"S", "D"}, 0.0), ({"R", "S"}, 0.5), ({"Z"}, 0.0), (set(), 0.0)],
    ids=["stopped", "waiting for a disk, a lock, a call", "computing", "ended", "gone"],
)
def test_it_does_not_wait_for_one_whose_own_doing_it_is(world: World, states: set[str], used_share: float):
    world.states, world.used_share = states, used_share
    assert world.goes_on(0.6) == pytest.approx(0.6, abs=1e-6)
    assert (world.clock.cells[FIRST_MEMBER] == 0) is (states <= {"Z"})


@pytest.mark.parametrize(
    ("other", "used_share", "waits"),
    [(RIG, 0.9, False), (RIG, 0.1, True), (ORDINARY, 0.9, True)],
    ids=["a rig that computes", "a rig that does not", "an ordinary process"],
)
def test_it_does_not_wait_for_one_that_a_rig_keeps_away(world: World, other: int, used_share: float, waits: bool):
    world.is_joined_by(other, used_share)
    assert (world.goes_on(0.6) < 0.1) is waits


def test_a_sender_that_computes_takes_no_processor_from_the_conductor():
    assert conductor.PRIORITY > PRIORITY


def test_it_does_not_wait_for_ever(world: World):
    assert world.goes_on(LOST_NS * 1e-9 + 1.0) == pytest.approx(1.0, abs=0.1)
    before_ns = world.clock.read(world.now_ns)[0]  # its conductor is lost
    assert world.clock.read(world.now_ns + LOST_NS + 1_000_000_000)[0] - before_ns == pytest.approx(1e9, abs=2e7)
    world.runs()
    world.conductor.tick(world.now_ns)
    assert world.goes_on(LOST_NS * 1e-9 + 1.0, runs=True, processor_runs=False) == pytest.approx(1.0, abs=0.1)
    world.conductor.end(world.now_ns)
    before_ns = world.clock.read(world.now_ns)[0]
    assert world.clock.read(world.now_ns + 1_000_000_000)[0] - before_ns == 1_000_000_000


def test_states_of_threads_are_the_kernel_s():
    with subprocess.Popen([sys.executable, "-c", ASLEEP], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        assert states_of(process.pid) <= {"T", "t"} and states_of(process.pid)
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert states_of(process.pid) == {"Z"}
    assert states_of(process.pid) == set()
    assert "R" in states_of(os.getpid())


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
    [lambda: time.sleep(0.05), lambda: threading.Event().wait(0.05), lambda: select.select([], [], [], 0.05)],
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


@pytest.mark.wire
def test_what_is_there_is_seen_however_short_the_wait():
    read, write = os.pipe()
    os.write(write, b"x")
    assert all(select_paced([read], [], [], 1e-7)[0] == [read] for _ in range(1000))
    os.close(read)
    os.close(write)


def members() -> list[int]:
    return [CLOCK.cells[i] for i in PLACES if CLOCK.cells[i]]


@pytest.mark.wire
def test_time_waits_for_the_test_an_emulator_and_a_rig(tmp_path: Path):
    with contextlib.closing(Bench(tmp_path)) as bench:
        bench.start_rig()
        assert bench.rig is not None
        children = {bench.emulator.popen.pid, bench.rig.popen.pid}
        assert set(members()) >= {os.getpid(), *children}
    assert not children & set(members())


@pytest.mark.wire
@pytest.mark.realtime  # two of its processes compute
def test_every_wait_is_longer_while_a_process_that_keeps_time_gets_no_processor():
    """It shares a processor with one that computes, and comes after it."""
    here = f"import os; os.sched_setaffinity(0, {{{min(os.sched_getaffinity(0))}}})\n"
    last = here + "os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))\n"
    keeper = (
        "from paced_clock import PacedClock\n"
        f"{last}clock = PacedClock(); clock.follow({CLOCK._path!r}); clock.keep(); print(flush=True)\n"
    )
    waiter = (
        "import select, threading, time\n"
        "from paced_clock import real_s\n"
        "before_s = real_s()\n"
        "for wait in (time.sleep, threading.Event().wait, lambda s: select.select([], [], [], s)):\n"
        "    wait(0.3); print(real_s() - before_s, flush=True); before_s = real_s()\n"
    )
    with contextlib.ExitStack() as stack:

        def begin(code: str) -> subprocess.Popen[str]:
            process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        kept = begin(keeper + BUSY)
        assert kept.stdout is not None
        kept.stdout.readline()
        begin(here + BUSY)
        before_s, waited_ns = real_s(), CLOCK.waited_ns(real_ns())
        took_s = [float(line) for line in begin(waiter).stdout or ()]
        waited_s = (CLOCK.waited_ns(real_ns()) - waited_ns) * 1e-9
    assert waited_s > 0.3 * (real_s() - before_s)
    assert len(took_s) == 3 and min(took_s) > 0.35, took_s
