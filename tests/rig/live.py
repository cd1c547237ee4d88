"""A rig in virtual time, on a stimulator and a load cell that the clock drives: for tests of `rig.control.rig`."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import pytest

from stimrig.rig import config
from stimrig.rig.control import pair
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Disk
from stimrig.rig.messages import (
    Direction,
    Event,
    FinishedEvent,
    LiveEvent,
    Preview,
    Profile,
    Status,
    StopEvidence,
    TestPlan,
    Threshold,
)
from stimrig.rig.requests import CalibrateMarkRequest, CalibrateStepRequest, PreviewRequest
from stimrig.rig.signals import Block
from stimrig.rig.tasks import Outcome, Task, Tasks
from tests.rig.fakes import RATE_HZ, FakeCell, FakeStimulator, hold, rest
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

T = TypeVar("T")
SPEED = 4.0
BLOCK_S, ACK_S = 0.02, 0.002
"""Rig seconds from one block of the cell to the next, and until a pulse is acknowledged."""
ANSWER_S, WORK_S = 0.002, 0.003
"""Real seconds until the stimulator answers, and for which a disk or a plan keeps whoever waits for it."""
PATIENCE_S = 100.0
LINE = {"stimulator": "/dev/pts/gone", "can": {"interface": "virtual"}, "speed": SPEED}


class LiveMachine(VirtualMachine):
    """Whose work takes its time; `asked` counts how often somebody had to wait for it or for the stimulator."""

    def __init__(self, clock: VirtualClock, disk: Disk | None) -> None:
        super().__init__(clock, disk)
        self.tasks = Tasks(self.clock, self._later)
        self.work_s, self.asked = WORK_S, 0

    def _later(self, action: Callable[[], Any], outcome: Outcome) -> None:
        self.asked += 1
        done_s = self.clock.now_s() + self.work_s * self.clock.speed
        self.clock.call_at(done_s, lambda: self._work(action, outcome))


class LiveStimulator(FakeStimulator):
    """Answers a moment later, or not at all."""

    def __init__(self, machine: LiveMachine) -> None:
        super().__init__(machine.clock)
        self.machine, self.ack_delay_s = machine, ACK_S
        self.missing = self.deaf = self.stalled = False

    async def open(self) -> dict[str, Any]:
        await self._wait()
        if self.missing:
            raise DeviceError("stimulator: the port is not there")
        return {"device": "live"}

    async def arm(self) -> None:
        self.armed = True
        await self._wait()

    def _acknowledge(self, number: int, error: str | None) -> None:
        if self.stalled:
            self.clock.call_at(self.clock.now_s() + ACK_S, lambda: self._acknowledge(number, error))
        else:
            super()._acknowledge(number, error)

    async def stop(self) -> None:
        self.armed = self.armed and self.stalled
        await self._wait()
        self.silent = self.stalled
        self._answer()

    async def state(self) -> tuple[bool, str]:
        await self._wait()
        self.silent = self.deaf or self.stalled
        return await super().state()

    async def _wait(self) -> None:
        self.machine.asked += 1
        await self.machine.tasks.sleep(ANSWER_S)


class MistakenBlock(Block):
    """What a driver with a mistake gives."""

    def __len__(self) -> int:
        raise ZeroDivisionError("a mistake in a driver")


class LiveCell(FakeCell):
    def __init__(self, clock: VirtualClock, stimulator: LiveStimulator) -> None:
        super().__init__(clock, stimulator)
        self.noise_nm, self.lasting_s = 0.01, 0.1
        self.gone = self.broken = False
        self._opened = 0

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        if self.gone:
            raise DeviceError("load cell: the bus is not there")
        self._opened += 1
        self._beat(self._opened, on_block, on_lost)
        return {"device": "live"}

    async def close(self) -> None:
        self._opened += 1

    def _beat(self, opened: int, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> None:
        if opened != self._opened:
            return
        if self.gone:
            on_lost("load cell: the bus is gone")
            return
        take = (lambda block: on_block(MistakenBlock(block.samples))) if self.broken else on_block
        self._block(take, round(BLOCK_S * RATE_HZ))
        self.clock.call_at(self.clock.now_s() + BLOCK_S, lambda: self._beat(opened, on_block, on_lost))


class LiveRig:
    """A `Rig` on both, opened, and every event that it published.

    Parameters
    ----------
    clock
        Of a rig that was closed: time goes on where that one ended.
    changes
        To its configuration.
    """

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        armed: bool = False,
        clock: VirtualClock | None = None,
        disk: Disk | None = None,
        **changes: Any,
    ) -> None:
        self.clock = clock or VirtualClock()
        self.clock.speed = SPEED
        self.machine = LiveMachine(self.clock, disk)
        self.stimulator = LiveStimulator(self.machine)
        self.cell = LiveCell(self.clock, self.stimulator)
        self.stimulator.armed = armed
        made = self.devices()
        found = SimpleNamespace(find=lambda kind, _: SimpleNamespace(create=lambda _settings, _machine: made[kind]))
        monkeypatch.setattr(pair, "devices", found)
        self.config = config.for_emulator(json.dumps(LINE), data_dir=folder, socket=folder / "s")
        self.config = self.config.model_copy(update=changes)
        self.events: list[Event] = []
        self.rig = Rig(self.config, self.machine, self.events.append)
        self.ask(self.rig.open())

    def devices(self) -> dict[str, Any]:
        return {"stimulator": self.stimulator, "load_cell": self.cell}

    def ask(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Obey a request to its end, and let everything else go on meanwhile."""
        task = self.begin(coroutine)
        self.until(task.done.is_set)
        return task.result

    def begin(self, coroutine: Coroutine[Any, Any, T]) -> Task[T]:
        """A request that goes on while others are made."""
        return self.machine.tasks.begin(coroutine, "request")

    def start(self, plan: TestPlan, key: str = "") -> Status:
        return self.ask(self.rig.start(plan, key))

    def play(self, test_id: str, **fields: Any) -> FinishedEvent:
        self.start(self.plan(test_id, **fields))
        self.wait("ready")
        return self.finished

    @property
    def finished(self) -> FinishedEvent:
        assert self.rig.finished is not None
        return self.rig.finished

    def preview(self, plan: TestPlan) -> Preview:
        return self.ask(self.rig.preview(PreviewRequest(plan=plan)))

    def stop(self, reason: str, by: str = "nurse") -> StopEvidence:
        return self.ask(self.rig.stop(reason, by))

    def rearm(self, by: str = "nurse") -> Status:
        return self.ask(self.rig.rearm(by, self.rig.latch))

    def step(self, direction: Direction = "up") -> None:
        self.ask(self.rig.calibrations.step(CalibrateStepRequest(direction=direction)))

    def mark(self, threshold: Threshold) -> None:
        self.ask(self.rig.calibrations.mark(CalibrateMarkRequest(threshold=threshold)))

    def stored(self, calibration_id: str) -> Status:
        self.ask(self.rig.calibrations.stored(calibration_id))
        return self.rig.status()

    def close(self) -> None:
        self.ask(self.rig.close())

    def plan(self, test_id: str, hold_s: float = 2.0, **fields: Any) -> TestPlan:
        segments = [rest(0.5), hold(on_s=hold_s, off_s=0.5)]
        return TestPlan(
            **{"test_id": test_id, "participant": "P", "profile": Profile(), "segments": segments, **fields}
        )

    def until(self, true: Callable[[], bool]) -> None:
        end_s = self.clock.now_s() + PATIENCE_S
        assert self.clock.run(self.machine.tasks, end_s, true), self.rig.status()

    def wait(self, *states: str) -> str:
        """Until the rig is in one of the states; gives the reason."""
        self.until(lambda: self.states[-1] in states)
        return self.rig.status().reason

    def event(self) -> LiveEvent | None:
        """The live event of what is new."""
        return self.rig.take_live()

    def wait_pulses(self, n: int) -> None:
        wanted = len(self.stimulator.sent) + n
        self.until(lambda: len(self.stimulator.sent) >= wanted)

    @property
    def states(self) -> list[str]:
        return [event.status.state for event in self.events if event.event == "state"]
