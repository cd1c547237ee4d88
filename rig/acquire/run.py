"""One test, played in a task of its own: arm, send a pulse at each deadline, stop, confirm the stop.

Deadlines are absolute on the monotonic clock. Health is checked before each pulse. A pulse that is late, or that comes
due before the previous one is acknowledged, is dropped and recorded, never sent in a burst. So is one that came due in
a pause of the computer (`rig.acquire.pauses`); the plan goes on where its clock is.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from stimrig.rig.acquire.angle_guard import AngleGuard
from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.evidence import AROUND_S, stop_device, watch_decay
from stimrig.rig.acquire.health import DiskWatch, Health, Watch
from stimrig.rig.acquire.pauses import Pauses
from stimrig.rig.acquire.plausibility import PlausibilityCheck
from stimrig.rig.acquire.receiver import FRESH_S, Receiver
from stimrig.rig.acquire.stream import SETTLE_S
from stimrig.rig.clock import Clock
from stimrig.rig.errors import DeviceError, JournalError
from stimrig.rig.gate import Gate
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.limits import Limit
from stimrig.rig.machine import Machine
from stimrig.rig.messages import StopEvidence, TestOutcome
from stimrig.rig.plan import PlannedTest
from stimrig.rig.score import Score
from stimrig.rig.signals import Pulse, PulseStatus, Recorded
from stimrig.rig.tasks import Signal

Cause = Literal["stopped", "fault", "withdrawn"]
"""`withdrawn`: nothing is wrong, so nothing latches. A stop or a fault that comes later outranks it."""


class Halt:
    """The only way to end a test early: the first reason counts, and wakes the sender at once.

    Set once, or once more after a withdrawal; `signal` wakes all who wait for that, `settled` those who wait for the
    evidence, which is None where no pulse could be sent.
    """

    def __init__(self, clock: Clock) -> None:
        self.signal, self.settled = Signal(), Signal()
        self.cause: Cause | None = None
        self.evidence: StopEvidence | None = None
        self.reason = ""
        self.time_s = 0.0
        self._clock = clock
        self._listeners: list[Callable[[], None]] = []

    def on_set(self, action: Callable[[], None]) -> None:
        """Call `action` when halted, before anything else goes on."""
        self._listeners.append(action)

    def set(self, cause: Cause, reason: str) -> bool:
        """End the test; False if it was already ending."""
        if self.cause not in (None, "withdrawn") or cause == self.cause:
            return False
        self.time_s = self._clock.now_s() if self.cause is None else self.time_s
        self.cause, self.reason = cause, reason
        self.signal.set()
        for action in self._listeners:
            action()
        return True


log = logging.getLogger("rig.run")

LEAD_S = 0.1
"""Real seconds between arming and the first deadline."""
MOST_BLOCKED_S = 2.0
"""Real seconds that the computer may stand still, in all, while a test waits for whole samples."""


@dataclass(slots=True)
class RunResult:
    """Result of a test."""

    outcome: TestOutcome
    reason: str
    evidence: StopEvidence
    summary: dict[str, Any]
    """Summary of `FinishedEvent`, as far as it is known without the recording."""
    rise_nm: float | None
    last_pulse_s: float | None
    last_sample_unix_s: float | None


class TestRun:
    """A test in progress.

    `table`: the limits narrowed by the participant's profile. `journal`: contains header and plan already. `halt`: ends
    the test early. `angle`: None: the rig has no angle sensor.
    """

    __test__ = False

    def __init__(
        self,
        test: PlannedTest,
        table: dict[str, Limit],
        journal: Journal,
        gate: Gate,
        receiver: Receiver,
        machine: Machine,
        halt: Halt,
        watch: Watch,
        angle: AngleReceiver | None,
    ) -> None:
        self.plan = test.plan
        self.score = Score(test, table, journal, machine.tasks)
        self.halt = halt
        self.started = Signal()
        self.t0_s: float | None = None
        self.told_pulses = 0
        """Count of entries of `Gate.done` that live events have published; written by the thread that makes them."""
        self.pauses: Pauses | None = None
        """From its arming on."""
        self._table = table
        self.journal = journal
        self.gate = gate
        self._receiver = receiver
        self._machine, self._tasks, self._clock = machine, machine.tasks, machine.tasks.clock
        self._watch = watch
        self._angle = AngleGuard(angle, test.plan, table, self._clock, watch)
        self._angle_counts: Recorded | None = None
        self._rest_nm: float | None = None
        self._outcome: TestOutcome = "fault"
        self._duration_s = 0.0
        self._counts = Recorded()
        halt.on_set(gate.shut)
        halt.on_set(self.score.shut)

    async def execute(self) -> RunResult:
        """Play the test to its end or its halt; never raises for a fault, the result says it."""
        cpu_s, began_s = self._machine.cpu_s(), self._clock.now_s()
        self.gate.reset()
        torque = self._table["torque_nm"]
        self._plausibility = PlausibilityCheck(
            self._table["torque_jump_nm"].hi,
            self._watch.stuck_torque_s * self._clock.speed,
            self._watch.clipped_torque_s * self._clock.speed,
            self._receiver.nominal_rate_hz,
            self._clock.speed,
            self._receiver.changes_lately(),
        )
        self._receiver.record(self.journal, (torque.lo, torque.hi), self._fault, self._plausibility.fault)
        self._angle.record(self.journal, self._fault)
        disk = DiskWatch(self.journal, self._machine)
        health = Health(self.gate, self._receiver, disk, self._clock, self._watch, self._angle.fault)
        self.pauses = Pauses(health, self.gate, self._receiver, self.journal, self._machine, self.halt.signal)
        try:
            if await self._arm(health):
                with self._machine.undisturbed():
                    await self._play(self.pauses)
        except (DeviceError, JournalError) as error:
            self._fault(str(error))
        except Exception as error:  # a bug in this program must stop stimulation, too
            log.exception("the test failed")
            self._fault(f"internal: {type(error).__name__}: {error}")
        evidence = await self._stop()
        self.halt.evidence = evidence
        self.halt.settled.set()  # whoever waits for it waits for no disk
        elapsed_s = max((self._clock.now_s() - began_s) / self._clock.speed, 1e-9)
        cpu_percent = 100 * (self._machine.cpu_s() - cpu_s) / elapsed_s
        await disk.end()
        return await self._result(evidence, cpu_percent)

    def segment(self) -> str | None:
        """Name of the current segment; None before the start and after the end."""
        return None if self.t0_s is None else self.score.segment_at(self.elapsed_s())

    @property
    def sent(self) -> int:
        return len(self.gate.lateness_s)

    @property
    def begun(self) -> bool:
        """True once a pulse was sent."""
        return self.t0_s is not None and self.sent > 0

    @property
    def torque_time_nms(self) -> float:
        """Torque above rest times time since the first pulse, N·m·s."""
        return self._receiver.torque_time.nms

    @property
    def ended_by(self) -> str:
        """Cause of its end: stopped, fault, withdrawn, or the reason why no more pulses were scheduled."""
        return self.halt.cause or self.score.ended_by

    def elapsed_s(self) -> float:
        """Time on the test's clock, s; 0 before its start."""
        return 0.0 if self.t0_s is None else max(0.0, self._clock.now_s() - self.t0_s)

    def _fault(self, reason: str) -> None:
        self.halt.set("fault", reason)

    async def _arm(self, health: Health) -> bool:
        """Wait until every sensor that this test relies on gives whole samples of now."""
        begun_s, waited_s = self._clock.now_s(), 0.0
        while not self.halt.signal.is_set():
            suspicion, has_angle = health.suspicion(), self._angle.fresh()
            if suspicion is None and has_angle and self._receiver.settled():
                return await self._open_gate()
            if suspicion is not None and waited_s >= suspicion[1]:
                self._fault(suspicion[0])
            if not has_angle and waited_s >= FRESH_S:
                self._fault(self._angle.fault() or "angle sensor: no angle arrived before the test; check its cable")
            if waited_s >= SETTLE_S:
                self._fault("load cell: samples arrive much faster than sample_rate_hz; check rig file and bus")
            waited_s += await self._tasks.look_again(self.halt.signal)
            blocked_s = (self._clock.now_s() - begun_s) / self._clock.speed - waited_s
            if not (blocked_s <= MOST_BLOCKED_S):  # who asked for the test may have gone since
                self._fault(f"the computer was blocked for {blocked_s:.1f} s before the test began; start it again")
        return False

    async def _open_gate(self) -> bool:
        self._plausibility.rate.begin()
        self._angle.begin()
        self._rest_nm = self._receiver.torque_around(0.1 * self._clock.speed)
        await self.gate.open(self.journal, self._table, self.halt.signal.is_set)
        return self.gate.is_open

    async def _play(self, pauses: Pauses) -> None:
        clock, current_ma = self._clock, self.plan.profile.current_ma
        period_s = 1 / self.plan.pulse_rate_hz
        t0_s = clock.now_s() + LEAD_S * clock.speed
        self.journal.append_json(Kind.START, {"t0_s": t0_s, "unix_s": clock.unix_s() + LEAD_S})
        self.t0_s = t0_s
        self._angle.started()
        self.started.set()
        late_s = self._watch.late_pulse_periods * period_s
        index, resting, rise = 0, True, Rise(self._table["width_rise_us"].hi, self.plan.pulse_rate_hz)
        while (width_us := self.score.pulse(index, self.torque_time_nms)) is not None:
            due_s = t0_s + index * period_s
            first = resting and width_us > 0
            if first:
                resting = False
                self._at_rest()
            if await self._tasks.wait(due_s - self._machine.head_start_s * clock.speed, self.halt.signal):
                return
            if (wrong := await pauses.fault(due_s, t0_s, first)) is not None:
                self._fault(wrong)
            if self.halt.signal.is_set():
                return
            if due_s < pauses.until_s and width_us > 0:
                rise.begin_anew()
            asked_us = rise.limited(width_us, bool(self.score.queue.jumps[index]))
            self.gate.feed()
            self._machine.hold_until(due_s)
            status = self.gate.fire(index, Pulse(asked_us, current_ma), due_s, due_s + late_s)
            rise.add(status, asked_us, width_us)
            index += 1
        await self._tasks.wait(t0_s + index * period_s, self.halt.signal)

    def _at_rest(self) -> None:
        """Right before the first pulse: what torque is rest, and no range or torque-time yet."""
        self._rest_nm = self._receiver.torque_around(0.1 * self._clock.speed)
        self._receiver.begin_range()
        self._receiver.torque_time.begin(self._rest_nm or 0.0, self._clock.now_s())

    async def _stop(self) -> StopEvidence:
        """Stop the device, ask its state, watch the torque fall, end the journal."""
        clock, cause = self._clock, self.halt.cause
        at_stop_nm = self._receiver.torque_around(AROUND_S * clock.speed)
        safe, state, error_text = await stop_device(self.gate)
        well = cause in (None, "withdrawn")
        if well and not safe:  # without the device's confirmation the end is a fault
            self._fault(f"the end of stimulation is not confirmed: {error_text or state}")
        elif well and (wrong := self._plausibility.rate.fault_at_end() or self._angle.fault_at_end()):
            self._fault(wrong)
        cause = self.halt.cause
        if cause in (None, "withdrawn"):
            await self._tasks.sleep(AROUND_S)  # samples still in transit belong to the test
            falling, words = True, "the test was withdrawn" if cause else "the test ended as planned"
        else:
            falling, words = await watch_decay(self.gate, self._receiver, self._tasks, self._rest_nm, at_stop_nm)
        now_s, last_s = clock.now_s(), self.gate.last_pulse_s
        planned_end_s = (self.t0_s or now_s) + self.score.duration_s
        self._end_journal(cause, planned_end_s if cause is None else now_s)
        return StopEvidence(
            confirmed=safe and falling,
            detail="; ".join(part for part in (f"device: {state or 'did not answer'}", error_text, words) if part),
            last_pulse_age_s=None if last_s is None else now_s - last_s,
            pulse_may_follow=self.gate.on_its_way is not None,
            device_state=state,
        )

    def _end_journal(self, cause: Cause | None, end_s: float) -> None:
        self.score.shut()
        self._outcome = "stopped" if cause == "withdrawn" else cause or "completed"
        stimulation_end_s = end_s if cause is None else self.halt.time_s
        if self.t0_s is not None:
            self._duration_s = max(0.0, stimulation_end_s - self.t0_s)
        content = {
            "outcome": self._outcome,
            "reason": self.halt.reason if cause else "",
            "time_s": end_s,
            "stimulation_end_s": stimulation_end_s,
            "ended_by": self.ended_by,
        }
        self.gate.release()
        self._counts, self._angle_counts = self._receiver.release(), self._angle.release()
        # If the end cannot be written, the journal is recovered later as one without an end.
        with contextlib.suppress(JournalError):
            if cause is not None:
                event = {"event": cause, "reason": self.halt.reason, "time_s": self.halt.time_s}
                self.journal.append_json(Kind.EVENT, event)
            self.journal.append_json(Kind.END, content)

    async def _result(self, evidence: StopEvidence, cpu_percent: float) -> RunResult:
        await self._tasks.work(self.journal.close)
        gate, speed, angle = self.gate, self._clock.speed, self._angle_counts
        summary: dict[str, Any] = {
            "duration_s": self._duration_s,
            "pauses": [pause.model_dump() for pause in self.pauses.all] if self.pauses else [],
            **asdict(self._counts),
            "pulses": self.sent,
            "dropped_pulses": gate.dropped,
            "lateness_ms": spread_ms([s / speed for s in gate.lateness_s]),
            "ack_delay_ms": spread_ms([s / speed for s in gate.ack_delay_s]),
            "charge_uc": gate.charge_uc,
            "torque_time_nms": self.torque_time_nms,
            "torque_peak_nm": self._receiver.peak_nm,
            "ended_by": self.ended_by,
            "cpu_percent": round(cpu_percent, 2),
            "stop": evidence.model_dump(),
        }
        if angle is not None:
            counts = asdict(angle)
            summary["angle"] = {name: counts[name] for name in ("samples", "lost_samples", "duplicate_samples")}
        reason = self.halt.reason if self._outcome != "completed" else ""
        last_s, last_unix_s = gate.last_pulse_s, self._receiver.last_unix_s
        return RunResult(self._outcome, reason, evidence, summary, self._rise_nm(), last_s, last_unix_s)

    def _rise_nm(self) -> float | None:
        """Largest change of the torque from rest since the first pulse, N·m; None if that is not known."""
        lo_nm, hi_nm = self._receiver.range_nm
        if self._rest_nm is None or not (lo_nm <= hi_nm):
            return None
        return max(hi_nm - self._rest_nm, self._rest_nm - lo_nm)


MISSED_S = 0.1
"""Rig seconds of pulses in a row that were left out: then the muscle has rested."""
CLIMB = 10
"""Pulses: after a rest that was not planned no more are held back."""


class Rise:
    """Limit on the next pulse's width: after omitted pulses the width climbs back within the largest step.

    `most_us`: the largest step from one pulse to the next, µs.
    """

    def __init__(self, most_us: float, pulse_rate_hz: float) -> None:
        self._most_us, self._most_missed = most_us, max(1, round(MISSED_S * pulse_rate_hz))
        self._felt_us, self._missed, self._climb = 0.0, 0, 0

    def begin_anew(self) -> None:
        """The muscle has rested: the width climbs from nothing, also where the sequence may jump."""
        self._felt_us, self._climb = 0.0, CLIMB

    def limited(self, width_us: float, jumps: bool) -> float:
        """A planned width, or as much of it as may follow the last pulse."""
        return width_us if jumps and not self._climb else min(width_us, self._felt_us + self._most_us)

    def add(self, status: PulseStatus, asked_us: float, width_us: float) -> None:
        """Record the outcome of a pulse. One that the device would make too short counts as none."""
        self._missed = self._missed + 1 if status is PulseStatus.DROPPED else 0
        if self._missed >= self._most_missed:
            self.begin_anew()
        if status is PulseStatus.UNACKNOWLEDGED:
            self._felt_us, self._climb = asked_us, self._climb - 1 if self._climb and asked_us < width_us else 0
        elif status is PulseStatus.REST:
            self._felt_us = 0.0


def spread_ms(durations_s: list[float]) -> dict[str, float]:
    """Median, 99th percentile and maximum, ms; empty for an empty list."""
    if not durations_s:
        return {}
    values = np.asarray(durations_s) * 1e3
    return {
        "median": float(np.median(values)),
        "p99": float(np.percentile(values, 99)),
        "max": float(np.max(values)),
    }
