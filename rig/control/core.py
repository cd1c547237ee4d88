"""Base of the rig: its devices, its state, its status, and how a test is ended."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import AsyncIterator, Callable
from typing import Any

from stimrig.rig import limits
from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.halt import Cause, Halt
from stimrig.rig.acquire.run import TestRun
from stimrig.rig.config import RigConfig
from stimrig.rig.control.angle_calibration import AngleCalibrating
from stimrig.rig.control.calibration import Calibration
from stimrig.rig.control.latch import Latch
from stimrig.rig.control.live import finite, live_event
from stimrig.rig.control.pair import Pair
from stimrig.rig.control.rest import Rest
from stimrig.rig.control.result import Result
from stimrig.rig.control.sealing import RecordingStore
from stimrig.rig.errors import BusyError, DeviceError, LatchChangedError, RigError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import AngleStatus, Event, FinishedEvent, LiveEvent, StateEvent, Status, StopEvidence
from stimrig.rig.tasks import Signal, Task, Turn
from stimrig.rig.trial import STOPPED, Trial

log = logging.getLogger("rig")

MAX_REQUEST_S = 60.0
"""Real seconds that a request may take: re-arming reopens both devices and seals journals that were left."""
RETRY_S = 1.0
"""Real seconds between two attempts to write a latch that the disk refused."""


class Core:
    """State and devices of a rig. Others use its subclass `stimrig.rig.control.rig.Rig`.

    Requests that begin something take their turn, one after the other. A stop never waits for it: it changes the state
    at once, and what was begun finds that out before it goes on.
    """

    def __init__(self, config: RigConfig, machine: Machine, publish: Callable[[Event], None]) -> None:
        self._watch = config.watch
        self._data_dir = config.data_dir
        self._machine, self._tasks, self._clock = machine, machine.tasks, machine.tasks.clock
        self._publish = publish
        self._table = config.limits.table()
        self._require_calibration = config.require_calibration
        self._store = RecordingStore(config, machine)
        self._latch = Latch(config.data_dir, machine)
        self._rest = Rest(config.data_dir, machine)
        self._latching: Task[None] | None = None
        """Writes the latch of the last stop."""
        self._closing = False
        self._turn = Turn(machine.tasks)
        self._turn_since_s: float | None = None
        self._trial = Trial()
        self._pair = Pair(config, machine, self._fault, self._lost)
        self._poses = AngleCalibrating(config.data_dir, config.angle_sensor, machine)
        self._has_angle = config.angle_sensor is not None
        self._halt: Halt | None = None
        self._run: TestRun | None = None
        self._playing: Task[None] | None = None
        self._evidence: StopEvidence | None = None
        self._evidence_ready = Signal()
        self._calibration: Calibration | None = None
        self._result = Result(config.data_dir, machine)
        self._instance, self._stops = machine.new_id()[:8], 0
        """How often it was stopped, a fault was reported, or why it is stopped became another reason."""
        self._published = ""
        """The latch that was told last."""
        self._born_s = self._clock.now_s()
        self._withdrawn: dict[str, str] = {}
        """Tests that must not begin any more, and why: the newest ones."""
        self.finished: FinishedEvent | None = None

    @property
    def table(self) -> dict[str, limits.Limit]:
        """Hard limits, narrowed by the rig file."""
        return self._table

    @property
    def speed(self) -> float:
        """Speed of the rig's clock."""
        return self._clock.speed

    @property
    def busy(self) -> bool:
        """Whether a test is in progress."""
        return self._trial.busy

    @property
    def latch(self) -> str:
        """What a person must have seen who re-arms: another one after each stop, and in each process."""
        return f"{self._instance}-{self._stops}"

    def status(self) -> Status:
        """State, devices and limits now."""
        trial, run, receiver = self._trial, self._run, self._pair.receiver
        calibration = self._calibration.status() if self._calibration else None
        elapsed_s = run.elapsed_s() if run else 0.0
        seen = receiver is not None and receiver.last_s is not None
        torque_nm = receiver.last_torque_nm if receiver else None
        cell = dict(self._pair.identity["load_cell"])
        if receiver and (measured_hz := receiver.measured_rate_hz()) is not None:
            cell["measured_rate_hz"] = round(measured_hz, 2)
        return Status(
            state=trial.state,
            reason=trial.told,
            latch=self.latch,
            test_id=trial.test_id,
            participant=trial.participant,
            segment=run.segment() if run else None,
            elapsed_s=elapsed_s,
            duration_s=run.score.longest_s if run else 0.0,
            stimulator=self._pair.identity["stimulator"],
            load_cell=cell,
            torque_age_s=receiver.age_s(self._clock.now_s()) if receiver and seen else None,
            torque_nm=finite(torque_nm),
            angle=self._angle_status(),
            calibration=calibration,
            calibrated=self._result.waiting,
            limits=limits.bounds(self._table),
            require_calibration=self._require_calibration,
            finished=self.finished,
        )

    def _angle_status(self) -> AngleStatus:
        if not self._has_angle:
            return AngleStatus()
        angle, bound = self._pair.angle, self._table["angle_rad"]
        age_s = None if angle is None else finite(angle.age_s(self._clock.now_s()))
        return AngleStatus(
            present=True,
            angle_rad=None if angle is None else finite(angle.angle_rad),
            velocity_rad_s=None if angle is None else finite(angle.velocity_rad_s),
            age_s=age_s,
            calibrated=self._poses.calibration is not None,
            range_rad=(bound.lo, bound.hi),
            problem="" if angle is None else angle.problem,
            pose=self._poses.first,
            calibration=self._poses.calibration,
        )

    def _angle_receiver(self) -> AngleReceiver:
        """The sensor's receiver. Raises DeviceError while the rig is disconnected."""
        if self._pair.angle is None:
            raise DeviceError("angle sensor: the rig is disconnected; re-arm it first")
        return self._pair.angle

    def _of_angle(self) -> dict[str, Any] | None:
        """What a journal's header says of the angle sensor; None: there is none."""
        angle = self._pair.angle
        if angle is None:
            return None
        sensor = angle.sensor
        return {
            "sample_rate_hz": sensor.sample_rate_hz,
            "of_the_cell": sensor.of_the_cell,
            "one_bus": sensor.on_the_cells_bus,
            "calibration": self._poses.described(sensor.scale),
        }

    def trouble(self) -> str | None:
        """Which task or request of this process hangs or has died; None: none. For the process's watchdog."""
        trial, receiver, since_s = self._trial, self._pair.receiver, self._turn_since_s
        if since_s is not None and self._clock.now_s() - since_s > MAX_REQUEST_S * self._clock.speed:
            return f"a request has been running for {(self._clock.now_s() - since_s) / self._clock.speed:.0f} s"
        if trial.busy and self._run is not None and (self._playing is None or self._playing.done.is_set()):
            return f"the task of test {trial.test_id} ended, but its test did not"
        if receiver is not None and not receiver.living and trial.state != "disconnected" and not trial.lost:
            return "the torque receiver has ended"
        return None

    def live(self, samples: bool = False) -> LiveEvent | None:
        """Torque and pulses since the last call, every sample if asked for; None if there is no new torque.

        It only reads, and takes what waits to be shown: it may be called from another thread than the tasks'.
        """
        run, receiver, now_s = self._run, self._pair.receiver, self._clock.now_s()
        if receiver is None:
            return None
        origin_s = run.t0_s if run and run.t0_s is not None else self._born_s
        event = live_event(receiver, run, origin_s, now_s, samples, self._pair.angle)
        if event is not None and run is not None:
            run.told_pulses += len(event.pulse_time_s)
        return event

    @contextlib.asynccontextmanager
    async def _in_turn(self) -> AsyncIterator[None]:
        """For requests that begin something: one after the other. Raises BusyError once the rig shuts down."""
        async with self._turn:
            if self._closing:
                raise BusyError("the rig is shutting down")
            self._turn_since_s = self._clock.now_s()
            try:
                yield
            finally:
                self._turn_since_s = None

    def _refuse_unseen(self, latch: str) -> None:
        """Raise LatchChangedError if the rig was stopped since `latch` was told: who asks has not seen it."""
        if latch == self.latch:
            return
        if self._trial.told:
            raise LatchChangedError(f"now: {self._trial.told}; look at the participant and the rig, then re-arm")
        raise LatchChangedError("the rig was stopped while this waited; look at the participant, then ask again")

    def _fault(self, reason: str) -> None:
        """A device reports a fault."""
        log.error("%s", reason)
        self._end("fault", reason)

    def _lost(self, reason: str) -> None:
        """A device is gone."""
        log.error("%s", reason)
        self._end("fault", reason, latch_idle=False)
        self._change(self._trial.disconnected(reason))

    def _end(self, cause: Cause, reason: str, latch_idle: bool = True) -> bool:
        """End the running test, or latch; True if a test runs."""
        self._stops += 1
        halt, busy = self._halt, self._trial.busy
        if busy and halt is not None:
            if not halt.set(cause, reason) and latch_idle:
                self._halted(reason)  # it was ending: both reasons are told
        elif latch_idle:
            self._halted(reason)
        return busy and halt is not None

    async def _remember(self, trial: Trial) -> None:
        """Write the latch file. If the disk fails, the rig stays stopped; a latch is written once the disk takes it.

        Until then the file holds "running" if a test had begun, so that the next process starts as uncertain.
        """
        try:
            await self._latch.write("running" if trial.state == "uncertain" else "latched", trial.reason)
        except RigError as error:
            log.error("%s", error)
            self._tasks.spawn(self._remember_later(), "latch file")

    async def _remember_later(self) -> None:
        await self._tasks.sleep(RETRY_S)
        async with self._turn:  # not while somebody re-arms
            if self._trial.state in STOPPED:
                await self._remember(self._trial)

    def _halted(self, reason: str) -> None:
        following = self._trial.halted(reason)
        if following.state in STOPPED or following.state == "sealing":
            # behind whatever is being written: a clear that was under way does not come last
            self._latching = self._tasks.spawn(self._remember(following), "latch file")
        self._change(following)

    def _change(self, trial: Trial) -> None:
        if trial.told not in ("", self._trial.told):
            self._stops += 1
        changed = trial != self._trial or self._published != self.latch
        self._trial, self._published = trial, self.latch
        if not trial.calibrating:
            self._calibration = None  # a stop, a fault or a lost device closes it
        if changed:
            log.info("state %s %s", trial.state, trial.reason, extra={"test_id": trial.test_id})
            self._publish(StateEvent(status=self.status()))
