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
from stimrig.rig.tasks import Outcome, Task, Tasks
from tests.rig.fakes import FakeCell, FakeStimulator, hold, rest
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

T = TypeVar("T")
SPEED = 4.0
PER_BLOCK, ACK_S = 32, 0.002
"""Samples of the cell at once, and rig seconds until a pulse is acknowledged."""
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
    """Answers a moment later."""

    def __init__(self, machine: LiveMachine) -> None:
        super().__init__(machine.clock)
        self.machine, self.ack_delay_s = machine, ACK_S

    async def _asked(self) -> None:
        self.machine.asked += 1
        await self.machine.tasks.sleep(ANSWER_S)


class LiveRig:
    """A `Rig` on both, opened, and every event that it published.

    `clock`: of a rig that was closed: time goes on where that one ended. `changes`: to its configuration.
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
        self.cell = FakeCell(self.clock, self.stimulator)
        self.cell.noise_nm, self.cell.lasting_s, self.cell.per_block = 0.01, 0.1, PER_BLOCK
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
        assert self.rig.player.finished is not None
        return self.rig.player.finished

    def preview(self, plan: TestPlan) -> Preview:
        return self.ask(self.rig.preview(PreviewRequest(plan=plan)))

    def stop(self, reason: str, by: str = "nurse") -> StopEvidence:
        return self.ask(self.rig.stop(reason, by))

    def rearm(self, by: str = "nurse") -> Status:
        return self.ask(self.rig.rearm(by, self.rig.state.latch))

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
