"""Tasks take turns in the order of their times and are never interrupted; the driver runs them in real time."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator

import pytest

from stimrig.rig.adapters.machine import Driver
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.tasks import LONGEST_LOOK_S, POLL_S, Signal, Turn
from tests.rig.fakes import slow_work
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

PATIENCE_S = 30.0


class OnMessage(list[tuple[str, float]]):
    def __init__(self, machine: VirtualMachine) -> None:
        self.clock = machine.clock

    def __call__(self, what: str) -> None:
        self.append((what, self.clock.now_s()))


@pytest.fixture
def machine() -> VirtualMachine:
    return VirtualMachine(VirtualClock(start_s=0.0))


@pytest.fixture
def told(machine: VirtualMachine) -> OnMessage:
    return OnMessage(machine)


def test_who_is_due_first_goes_on_first_and_of_those_who_asked_first(machine: VirtualMachine, told: OnMessage):
    async def waits(name: str, until_s: float) -> None:
        assert not await machine.tasks.wait(until_s)
        told(name)

    for name, until_s in (("c", 3.0), ("a", 1.0), ("d", 3.0), ("b", 2.0), ("past", -1.0)):
        machine.tasks.spawn(waits(name, until_s), name)
    machine.wait(2.5)
    assert told == [("past", 0.0), ("a", 1.0), ("b", 2.0)]
    machine.clock.advance(5.0)
    machine.wait(0.0)
    assert told[3:] == [("c", 7.5), ("d", 7.5)]


def test_a_sleep_lasts_so_many_real_seconds(machine: VirtualMachine):
    machine.clock.speed = 4.0
    machine.run(machine.tasks.sleep(2.0))
    assert machine.clock.now_s() == 8.0


def test_a_computer_that_stood_still_has_hardly_waited(machine: VirtualMachine):
    machine.clock.call_at(0.002, lambda: machine.clock.advance(0.8))
    assert machine.run(machine.tasks.look_again()) == LONGEST_LOOK_S
    assert machine.run(machine.tasks.look_again()) == pytest.approx(POLL_S)


def test_a_signal_wakes_all_who_wait_and_their_times_wake_them_no_more(machine: VirtualMachine, told: OnMessage):
    signal, never = Signal(), Signal()

    async def waits(name: str) -> None:
        told(f"{name} {await machine.tasks.wait(2.0, never, signal)}")
        told(f"{name} {await machine.tasks.wait(5.0, never)}")

    for name in ("a", "b"):
        machine.tasks.spawn(waits(name), name)
    machine.clock.call_at(1.0, signal.set)
    machine.wait(9.0)
    assert told == [("a True", 1.0), ("b True", 1.0), ("a False", 5.0), ("b False", 5.0)]


def test_what_is_set_already_is_not_waited_for_until_it_is_cleared(machine: VirtualMachine):
    signal = Signal()
    signal.set()
    assert machine.run(machine.tasks.wait(5.0, signal))
    assert machine.clock.now_s() == 0.0
    signal.clear()
    assert not machine.run(machine.tasks.wait(5.0, signal))
    assert machine.clock.now_s() == 5.0


def test_one_at_a_time_in_the_order_of_asking_also_after_an_error(machine: VirtualMachine, told: OnMessage):
    turn = Turn(machine.tasks)

    async def takes(name: str) -> None:
        async with turn:
            told(name)
            await machine.tasks.sleep(1.0)
            if name == "b":
                raise ZeroDivisionError

    asked = {name: machine.tasks.spawn(takes(name), name) for name in "abc"}
    machine.clock.call_at(1.5, lambda: machine.tasks.begin(takes("d"), "d"))
    machine.wait(9.0)
    machine.run(takes("e"))
    assert told == [("a", 0.0), ("b", 1.0), ("c", 2.0), ("d", 3.0), ("e", 9.0)]
    assert [type(task.error) for task in asked.values()] == [type(None), ZeroDivisionError, type(None)]


def test_what_takes_long_gives_its_result_or_its_error_and_holds_up_nobody(machine: VirtualMachine, told: OnMessage):
    slow_work(machine, 1.0)
    tasks = machine.tasks

    async def beats() -> None:
        while True:
            await tasks.sleep(0.4)
            told("beat")

    tasks.spawn(beats(), "beats")
    assert machine.run(tasks.work(divmod, 7, 2)) == (3, 1)
    assert told == [("beat", 0.4), ("beat", 0.8)]
    with pytest.raises(ZeroDivisionError):
        machine.run(tasks.join(tasks.spawn(tasks.work(divmod, 7, 0), "divided")))


def test_what_begins_when_the_computer_stood_still_counts_before_what_is_due_by_then(
    machine: VirtualMachine, told: OnMessage
):
    halt = Signal()

    async def sends() -> None:
        told(f"halted {await machine.tasks.wait(1.0, halt)}")

    async def stops() -> None:
        halt.set()
        told("stop")

    machine.tasks.spawn(sends(), "sender")
    machine.wait(0.5)
    machine.clock.advance(3.0)
    machine.tasks.begin(stops(), "stop")
    machine.wait(0.0)
    assert told == [("stop", 3.5), ("halted True", 3.5)]


@pytest.fixture
def driver() -> Iterator[Driver]:
    made = Driver(MonotonicClock(100.0))
    yield made
    made.end()


def test_tasks_share_one_thread_and_what_takes_long_has_another(driver: Driver):
    async def where() -> tuple[str, str]:
        return threading.current_thread().name, await driver.tasks.work(lambda: threading.current_thread().name)

    tasks = [driver.submit(where) for _ in range(10)]
    for name, worker in (task.result(PATIENCE_S) for task in tasks):
        assert name == "rig" and worker.startswith("work")


def test_the_driver_waits_for_times_and_passes_on_errors(driver: Driver):
    async def waits() -> float:
        asked_s = driver.tasks.clock.now_s()
        await driver.tasks.sleep(0.05)
        return driver.tasks.clock.now_s() - asked_s

    assert driver.submit(waits).result(PATIENCE_S) >= 5.0

    async def fails() -> None:
        await driver.tasks.work(divmod, 1, 0)

    with pytest.raises(ZeroDivisionError):
        driver.submit(fails).result(PATIENCE_S)


def test_a_mistake_in_what_comes_ends_no_driver(driver: Driver, caplog: pytest.LogCaptureFixture):
    driver.post(lambda: 1 // 0)
    signal = Signal()
    waiting = driver.submit(lambda: driver.tasks.wait(math.inf, signal))
    driver.post(signal.set)
    assert waiting.result(PATIENCE_S)
    assert "could not be taken" in caplog.text
