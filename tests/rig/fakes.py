"""Devices that live on a virtual clock, in one thread, and tests on them: for gate, receivers, score and run."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.rig import archive, assembly, journal, limits, plan
from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.health import DEFAULT_WATCH, Watch
from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.run import Halt, RunResult, TestRun
from stimrig.rig.adapters.files import Files
from stimrig.rig.errors import DeviceError, RigError
from stimrig.rig.gate import Gate
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.limits import Admitted, Steps
from stimrig.rig.messages import AdaptivePlan, AnglePlan, Profile, SegmentPlan, TestPlan
from stimrig.rig.signals import ANGLE_SAMPLE, SAMPLE, Ack, AngleScale, Block, LateError
from stimrig.rig.tasks import Outcome
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

RATE_HZ = 1600.0
PER_BLOCK = 16
"""Samples that the cell gives at once."""
BEGINS_S = 0.175
"""A test's clock begins so long after it was asked for: torque has settled by then, and its first pulse has a lead."""
OF_ANGLE = {"angle": {"sample_rate_hz": 200.0, "of_the_cell": False, "one_bus": True, "calibration": {"by": "nurse"}}}


def rest(duration_s: float) -> SegmentPlan:
    return SegmentPlan(name="rest", sequence="rest", settings={"duration_s": duration_s})


def hold(name: str = "hold", on_s: float = 1.0, **settings: float) -> SegmentPlan:
    return SegmentPlan(name=name, sequence="steps", settings={"on_s": on_s, "off_s": 0.0, "repeats": 1, **settings})


class FakeStimulator:
    """Acknowledges each pulse `ack_delay_s` later; its faults are plain attributes."""

    steps = Steps()

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.sent: list[tuple[float, Admitted]] = []
        self.acked_s: list[float] = []
        self.fed_s: list[float] = []
        self.stopped_s: list[float] = []
        self.armed = False
        self.ack_delay_s: float | None = 0.001
        self.error: str | None = None
        self.send_error: str | None = None
        self.silent = self.stalled = False
        self.on_send: Callable[[int], None] = lambda _: None
        self._number = 0

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        self.on_ack, self.on_lost = on_ack, on_lost

    @property
    def stops(self) -> int:
        return len(self.stopped_s)

    async def open(self) -> dict[str, Any]:
        await self._asked()
        return {"device": "fake"}

    async def arm(self) -> None:
        self._answer()
        self.armed = True
        await self._asked()

    def feed(self) -> None:
        self.fed_s.append(self.clock.now_s())

    def send(self, pulse: Admitted, latest_s: float) -> int:
        if not (self.clock.now_s() <= latest_s):
            raise LateError
        if self.send_error:
            raise DeviceError(self.send_error)
        assert self.armed
        self._number = (self._number + 1) % 64
        number, error = self._number, self.error
        self.sent.append((self.clock.now_s(), pulse))
        self.on_send(len(self.sent))
        if self.ack_delay_s is not None:
            at = self.clock.now_s() + self.ack_delay_s
            self.clock.call_at(at, lambda: self._acknowledge(number, error))
        return number

    def _acknowledge(self, number: int, error: str | None) -> None:
        if self.stalled:
            self.clock.call_at(self.clock.now_s() + 0.002, lambda: self._acknowledge(number, error))
            return
        self.acked_s.append(self.clock.now_s())
        self.on_ack(Ack(number, self.clock.now_s(), error))

    async def stop(self) -> None:
        self.stopped_s.append(self.clock.now_s())
        self.armed = self.armed and self.stalled
        await self._asked()
        self._answer()

    async def state(self) -> tuple[bool, str]:
        await self._asked()
        self._answer()
        return not self.armed, "armed" if self.armed else "not initialised"

    def close(self) -> None:
        self.armed = False

    async def _asked(self) -> None:
        """Wait as long as it takes to answer."""

    def _answer(self) -> None:
        if self.silent or self.stalled:
            raise DeviceError("stimulator fake: no answer")


class MistakenBlock(Block):
    """What a driver with a mistake gives."""

    def __len__(self) -> int:
        raise ZeroDivisionError("a mistake in a driver")


class FakeCell:
    """Blocks with a 16-bit counter, delivered by the clock while it is open; torque follows the pulses slowly."""

    sample_rate_hz = RATE_HZ
    counter_modulus = 65536

    def __init__(self, clock: VirtualClock, stimulator: FakeStimulator) -> None:
        self.clock = clock
        self.stimulator = stimulator
        self.silent = self.nan = self.gone = self.broken = self.is_open = False
        self.per_block = PER_BLOCK
        self.add_nm = 0.0
        self.skip = 0
        self.rate = 1.0
        self.noise_nm = 0.0
        self.ceiling_nm = math.inf
        self.lasting_s = 0.03
        self.read_share = 1.0  # below 1 its reader falls behind
        self._credit = 0.0
        self.step_nm = 0.0
        self.sign = 1
        self.frozen = False
        self.last_nm = 0.0
        self._rng = np.random.default_rng(0)
        self.counter = 65000
        self.torque_nm = 0.0
        self.held: Callable[[float], bool] = lambda _: False
        self._held: list[Any] = []
        self._seen = self._opened = 0

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        if self.gone:
            raise DeviceError("load cell: the bus is not there")
        self._opened, self.is_open = self._opened + 1, True
        self._schedule(self._opened, self.clock.now_s(), on_block, on_lost)
        return {"device": "fake", "bus": "can0"}

    async def close(self) -> None:
        self.is_open = False

    def _schedule(
        self, opened: int, before_s: float, on_block: Callable[[Block], None], on_lost: Callable[[str], None]
    ) -> None:
        """The next block, one period after the time at which the one before was due."""
        due_s = round(before_s + self.per_block / RATE_HZ / self.rate, 9)

        def beat() -> None:
            if not self.is_open or opened != self._opened:
                return
            if self.gone:
                on_lost("load cell: the bus is gone")
                return
            take = (lambda block: on_block(MistakenBlock(block.samples))) if self.broken else on_block
            self._block(take, self.per_block)
            self._schedule(opened, due_s, on_block, on_lost)

        self.clock.call_at(due_s, beat)

    def _block(self, take: Callable[[Block], None], n: int) -> None:
        self.counter += n + self.skip
        self.skip = 0
        if self.silent:
            return
        now_s = self.clock.now_s()
        recent = [p for t, p in self.stimulator.sent[-3:] if now_s - t < self.lasting_s]
        target_nm = 0.02 * recent[-1].pulse_width_us if recent else 0.0
        self.torque_nm += (target_nm - self.torque_nm) * (n / RATE_HZ) / 0.1
        block = np.zeros(n, SAMPLE)
        block["host_time_s"] = now_s
        block["stamp_s"] = np.nan
        block["torque_nm"] = np.nan if self.nan else self.torque_nm + self.add_nm
        if self.noise_nm:
            block["torque_nm"] += self.noise_nm * self._rng.standard_normal(n)
        clipped_nm = self.sign * np.minimum(block["torque_nm"], self.ceiling_nm)
        if self.step_nm:
            clipped_nm = self.step_nm * np.round(clipped_nm / self.step_nm)
        block["torque_nm"] = self.last_nm if self.frozen else clipped_nm
        self.last_nm = block["torque_nm"][-1]
        block["counter"] = (self.counter + np.arange(n)) % 65536
        block["sync"][0] = len(self.stimulator.sent) > self._seen
        self._seen = len(self.stimulator.sent)
        self._held.append(block)
        if self.held(now_s):  # the host or the bus stands still; what was measured comes afterwards, all at once
            return
        self._credit = min(1.0, self._credit + self.read_share)
        if self._credit < 1.0:
            return
        self._credit = 0.0
        block = self._held.pop(0) if self.read_share < 1.0 else np.concatenate(self._held)
        block["host_time_s"] = now_s
        if self.read_share == 1.0:
            self._held.clear()
        take(Block(block))


class VirtualRig:
    """Gate, receiver and run on fakes and a virtual clock."""

    def __init__(
        self,
        folder: Path,
        segments: list[SegmentPlan] | None = None,
        watch: Watch = DEFAULT_WATCH,
        adaptive: AdaptivePlan | None = None,
        base: dict[str, limits.Limit] = limits.HARD_LIMITS,
        kind: str = "pre-session",
        angle: AnglePlan | None = None,
        has_sensor: bool = False,
        **profile: Any,
    ) -> None:
        self.machine = VirtualMachine()
        self.clock = self.machine.clock
        self.sensor = FakeSensor(self.machine)
        self.angle = AngleReceiver(self.sensor, self.machine.tasks) if has_sensor else None
        self.stimulator = FakeStimulator(self.clock)
        self.cell = FakeCell(self.clock, self.stimulator)
        self.halt = Halt(self.clock)

        def fault(reason: str) -> None:
            self.halt.set("fault", reason)

        self.gate = Gate(self.stimulator, self.clock, fault, fault)
        self.receiver = Receiver(self.cell, self.machine.tasks, fault)
        segments = segments or [
            rest(0.5),
            SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 1.0, "down_s": 1.0}),
            rest(0.5),
        ]
        self.plan = TestPlan(
            test_id="t", participant="P", kind=kind, profile=Profile(**profile), segments=segments, adaptive=adaptive,
            angle=angle,
        )  # fmt: skip
        self.table = limits.for_plan(base, self.plan)
        self.test = plan.build(self.plan, self.table)
        self.path = folder / "t.journal"
        self.journal = journal_at(self.path)
        self.run = TestRun(
            self.test, self.table, self.journal, self.gate, self.receiver, self.machine, self.halt, watch, self.angle
        )
        self.journal.append_json(Kind.HEADER, header(self.run, self.clock) | ({} if self.angle is None else OF_ANGLE))
        self.journal.append(Kind.PLAN, self.run.score.queue.pulse_width_us.astype("<f8").tobytes())

    def at(self, time_s: float, action: Callable[[], object]) -> None:
        """Do something at a time on the test's clock (its start: torque settled, then the lead)."""
        self.clock.call_at(self.clock.now_s() + BEGINS_S + time_s, lambda: void(action()))

    def execute(self) -> RunResult:
        if self.angle is not None:
            self.angle.start()
        self.machine.run(self.receiver.open())
        return self.machine.run(self.run.execute())

    def recording(self) -> assembly.Recording:
        return assembly.assemble(journal.read(self.path))

    def seal(self) -> archive.Sealed:
        return archive.seal(self.recording(), self.path.parent, self.machine.disk)


def journal_at(path: Path) -> Journal:
    return Journal(Files().create(path))


def slow_work(machine: VirtualMachine, *real_s: float) -> None:
    """From now on each piece of work takes so long, the first ones and then the last one of these; none: no time."""
    left = [*real_s]

    def later(action: Callable[[], Any], outcome: Outcome) -> None:
        takes_s = (left.pop(0) if len(left) > 1 else left[0]) * machine.clock.speed
        machine.clock.call_at(machine.clock.now_s() + takes_s, lambda: VirtualMachine._work(action, outcome))

    machine.tasks._worker = later if real_s else VirtualMachine._work


def header(run: TestRun, clock: VirtualClock) -> dict[str, Any]:
    return {
        "recording_id": "0" * 32,
        "plan": run.plan.model_dump(mode="json"),
        "segments": [segment._asdict() for segment in run.score.queue.segments],
        "current_ma": run.plan.profile.current_ma,
        "sample_rate_hz": RATE_HZ,
        "software": "stimrig test",
        "configuration": {},
        "time_s": clock.now_s(),
        "unix_s": clock.unix_s(),
    }


def void(*_: object) -> None: ...


PULSES_HZ = 40.0


FIXED = [rest(0.5), hold("first"), SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 0.5, "down_s": 0.5})]


def adaptive(
    folder: Path, max_duration_s: float = 10.0, max_nms: float = 1e4, fixed: list[SegmentPlan] = FIXED,
    patience_s: float = 0.0, **more: Any,
) -> VirtualRig:  # fmt: skip
    bounds = AdaptivePlan(max_duration_s=max_duration_s, max_torque_time_nms=max_nms, patience_s=patience_s)
    return VirtualRig(folder, fixed, adaptive=bounds, **more)


def extend(rig: VirtualRig, after: int, segments: list[SegmentPlan]) -> None:
    """Lay segments behind pulse `after`: before the test begins, or beside its sender."""
    return rig.machine.tasks.begin(rig.run.score.extend(after, segments), "extend").result


def refusals(*requests: Callable[[], object]) -> list[RigError]:
    found: list[RigError] = []
    for request in requests:
        with pytest.raises(RigError) as told:
            request()
        found.append(told.value)
    return found


def widths_sent(rig: VirtualRig) -> list[int]:
    return [pulse.pulse_width_us for _, pulse in rig.stimulator.sent]


ANGLE_HZ = 200.0


def still(_: float) -> float:
    """A joint that is held at 60 degrees."""
    return math.radians(60)


class FakeSensor:
    """Blocks with a 16-bit counter while it is open, degrees with an offset and reversed; faults are attributes."""

    sample_rate_hz = ANGLE_HZ
    counter_modulus = 65536
    scale = AngleScale(offset=30.0, direction=-1, radians_per_unit=math.pi / 180)
    of_the_cell = False
    on_the_cells_bus = True

    def __init__(self, machine: VirtualMachine, angle_rad: Callable[[float], float] = still) -> None:
        self.tasks, self.clock, self.angle_rad = machine.tasks, machine.clock, angle_rad
        self.silent = self.nan = self.repeating = self.gone = False
        self.fault: int = 0
        self.add_deg = 0.0
        self.rate = 1.0
        self.skip = 0
        self.opens_s = self.closes_s = self.late_s = 0.0
        self.noise_deg = 0.02
        self.per_block = 2
        self.counter = 65400
        self.done: list[str] = []
        self._opened = 0
        self._rng = np.random.default_rng(3)

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        await self.tasks.sleep(self.opens_s)
        if self.gone:
            raise DeviceError("angle sensor: no adapter")
        self.done.append("opened")
        self.on_lost, self._opened = on_lost, len(self.done)
        first_s = self.clock.now_s() + 0.0003  # between two blocks of the cell
        self.clock.call_at(first_s, lambda: self._beat(on_block, self._opened))
        return {"device": "here"}

    async def close(self) -> None:
        self._opened = 0
        await self.tasks.sleep(self.closes_s)
        self.done.append("closed")

    def block(self, n: int) -> Block:
        """The next samples; the last one is taken now."""
        now_s = self.clock.now_s()
        if not self.repeating:
            self.counter += n + self.skip
        self.skip = 0
        times_s = now_s - np.arange(n)[::-1] / ANGLE_HZ
        samples = np.zeros(n, ANGLE_SAMPLE)
        samples["host_time_s"], samples["stamp_s"] = now_s, np.nan
        degrees = np.degrees([self.angle_rad(t) for t in times_s]) + self.noise_deg * self._rng.standard_normal(n)
        samples["raw"] = np.nan if self.nan else 30.0 - degrees + self.add_deg
        samples["angle_rad"] = self.scale.angle_rad(samples["raw"])
        samples["counter"] = (self.counter - np.arange(n)[::-1]) % 65536
        samples["fault"] = self.fault
        return Block(samples)

    def _beat(self, on_block: Callable[[Block], None], opened: int) -> None:
        if self._opened != opened:
            return
        if self.gone:
            self.on_lost("angle sensor on x: the bus was lost: gone")
            return
        now_s, block = self.clock.now_s(), self.block(self.per_block)

        def arrive() -> None:
            block.samples["host_time_s"] = self.clock.now_s()
            on_block(block)

        if not self.silent:
            self.clock.call_at(now_s + self.late_s, arrive) if self.late_s else arrive()
        self.clock.call_at(now_s + self.per_block / ANGLE_HZ / self.rate, lambda: self._beat(on_block, opened))
