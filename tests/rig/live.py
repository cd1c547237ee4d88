"""A rig in this process on devices that live in threads of real time: for tests of `rig.control.rig` without a wire."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig import config
from rig.clock import MonotonicClock
from rig.control import pair
from rig.control.rig import Rig
from rig.errors import DeviceError
from rig.limits import Admitted, Steps
from rig.messages import Event, Profile, SegmentPlan, TestPlan
from rig.signals import SAMPLE, Ack, LateError, TorqueBlock
from tests.harness.paced_time import CLOCK

RATE_HZ = 1600.0
SPEED = 4.0
LINE = {"stimulator": "/dev/pts/gone", "can": {"interface": "virtual"}}


class LiveStimulator:
    """Acknowledges from a thread of its own."""

    steps = Steps()
    silence_s = 0.0

    def __init__(self, clock: MonotonicClock) -> None:
        self.clock = clock
        self.missing = self.deaf = self.stalled = False
        self.error: str | None = None
        self.armed = False
        self.sent: list[tuple[float, Admitted]] = []
        self._acks: queue.Queue[int] = queue.Queue()
        self._number = 0
        threading.Thread(target=self._answer, daemon=True).start()

    def open(self) -> dict[str, Any]:
        if self.missing:
            raise DeviceError("stimulator: the port is not there")
        return {"device": "live"}

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        self.on_ack, self.on_lost = on_ack, on_lost

    def _answer(self) -> None:
        while True:
            number = self._acks.get()
            while self.stalled:
                time.sleep(0.001)
            self.on_ack(Ack(number, self.clock.now_s(), self.error))

    def arm(self) -> None:
        self.armed = True

    def feed(self) -> None: ...

    def send(self, pulse: Admitted, latest_s: float) -> int:
        if not (self.clock.now_s() <= latest_s):
            raise LateError
        assert self.armed
        self._number = (self._number + 1) % 64
        self.sent.append((self.clock.now_s(), pulse))
        self._acks.put(self._number)
        return self._number

    def stop(self) -> None:
        if self.stalled:
            raise DeviceError("stimulator: no answer")
        self.armed = False

    def state(self) -> tuple[bool, str]:
        if self.deaf or self.stalled:
            raise DeviceError("stimulator: no answer")
        return not self.armed, "armed" if self.armed else "not initialised"

    def close(self) -> None:
        self.armed = False


class LiveCell:
    """Torque that follows the pulses, with a counter, 1600 samples a rig second."""

    sample_rate_hz = RATE_HZ
    counter_modulus = 65536

    def __init__(self, clock: MonotonicClock, stimulator: LiveStimulator) -> None:
        self.clock, self.stimulator = clock, stimulator
        self.silent = self.gone = self.broken = self.stuck = False
        self.rate = 1.0
        self._rng = np.random.default_rng(1)
        self._began_s = clock.now_s()
        self._count = 0
        self._torque_nm = 0.0

    def open(self) -> dict[str, Any]:
        if self.gone:
            raise DeviceError("load cell: the bus is not there")
        return {"device": "live"}

    def read(self, timeout_s: float) -> TorqueBlock:
        time.sleep(min(0.002, timeout_s))
        now_s = self.clock.now_s()
        if self.gone:
            raise DeviceError("load cell: the bus is gone")
        if self.broken:
            raise ZeroDivisionError("a mistake in a driver")
        due = int((now_s - self._began_s) * RATE_HZ * self.rate)
        block = np.zeros(0 if self.silent else max(0, due - self._count), SAMPLE)
        block["host_time_s"], block["stamp_s"], block["sync"] = now_s, np.nan, 255
        recent = [pulse for time_s, pulse in self.stimulator.sent[-2:] if now_s - time_s < 0.1]
        target_nm = 0.02 * recent[-1].pulse_width_us if recent else 0.0
        fallen = np.exp(-np.arange(1, len(block) + 1) / RATE_HZ / 0.1)  # a muscle of 0.1 s
        block["torque_nm"] = target_nm + (self._torque_nm - target_nm) * fallen
        self._torque_nm = block["torque_nm"][-1] if len(block) else self._torque_nm
        block["torque_nm"] += 0.01 * self._rng.standard_normal(len(block))
        if self.stuck:
            block["torque_nm"] = 0.25
        block["counter"] = (self._count + np.arange(len(block))) % 65536
        self._count = max(due, self._count)
        return TorqueBlock(block)

    def close(self) -> None: ...


class LiveRig:
    """A `Rig` on both, and every event that it published."""

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        rate: float = 1.0,
        armed: bool = False,
        speed: float = SPEED,
    ) -> None:
        assert CLOCK.paced, "mark the test `wire`: this rig keeps time, and other tests compute beside it"
        self.clock = MonotonicClock(speed)
        self.stimulator = LiveStimulator(self.clock)
        self.cell = LiveCell(self.clock, self.stimulator)
        made = {"stimulator": self.stimulator, "load_cell": self.cell}
        found = SimpleNamespace(find=lambda kind, _: SimpleNamespace(create=lambda _settings, _clock: made[kind]))
        monkeypatch.setattr(pair, "devices", found)
        self.config = config.for_emulator(json.dumps({**LINE, "speed": speed}), data_dir=folder, socket=folder / "s")
        self.cell.rate, self.stimulator.armed = rate, armed
        self.events: list[Event] = []
        self.rig = Rig(self.config, self.clock, self.events.append)
        self.rig.open()

    def plan(self, test_id: str, hold_s: float = 2.0, **fields: Any) -> TestPlan:
        segments = [
            SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 0.5}),
            SegmentPlan(name="hold", sequence="steps", settings={"on_s": hold_s, "off_s": 0.5, "repeats": 1}),
        ]
        return TestPlan(
            **{"test_id": test_id, "participant": "P", "profile": Profile(), "segments": segments, **fields}
        )

    def wait(self, *states: str, timeout_s: float = 10.0) -> str:
        """Until the rig is in one of the states; gives the reason."""
        end_s = time.monotonic() + timeout_s
        while (status := self.rig.status()).state not in states:
            assert time.monotonic() < end_s, status
            time.sleep(0.005)
        return status.reason

    def wait_pulses(self, n: int) -> None:
        """Until so many more pulses were sent."""
        wanted, end_s = len(self.stimulator.sent) + n, time.monotonic() + 10
        while len(self.stimulator.sent) < wanted:
            assert time.monotonic() < end_s, self.rig.status()
            time.sleep(0.005)

    @property
    def states(self) -> list[str]:
        """Every state that was told, in order."""
        return [event.status.state for event in self.events if event.event == "state"]
