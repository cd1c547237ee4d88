"""The rig: both devices, one test at a time, its status and events. Independent of the sockets."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

from stimrig.rig import limits, plan
from stimrig.rig.acquire.angle_check import degrees
from stimrig.rig.acquire.angle_guard import await_angle, check_start
from stimrig.rig.control.angle_calibration import APART_RAD
from stimrig.rig.control.calibrating import Calibrating
from stimrig.rig.control.calibration import check_profile, check_range
from stimrig.rig.control.playing import LONGEST_WORDS, check_names
from stimrig.rig.errors import (
    BusyError,
    ConfigError,
    DeviceError,
    LatchChangedError,
    PlanError,
    RefusedError,
    WithdrawnError,
)
from stimrig.rig.limits import Limit
from stimrig.rig.messages import PASSIVE, AnglePoseRequest, Sequences, StateEvent, Status, StopEvidence, TestPlan
from stimrig.rig.trial import Trial

log = logging.getLogger("rig")

MIN_KEY = 16
NO_SENSOR = "{}: this rig has no angle sensor; name one in its rig file (docs/rig-file.md)"
STOP_TIMEOUT_S = 6.0
"""Real seconds to wait for the evidence of a stop, including the fall of the torque."""
STORED_S = 7.0
"""Real seconds after which a stop is answered although the disk has not taken its latch."""
SEALED_WITHIN_S = 30.0
"""Real seconds within which a test that was stopped is sealed."""


class Rig(Calibrating):
    """Owns the devices. All but `status`, `trouble` and `live` are tasks of the machine.

    Parameters
    ----------
    publish
        Receives all events except live ones; must not block.
    """

    async def open(self) -> None:
        """Seal what a crash left, then connect; a missing device is reported in the status, not raised.

        Raises
        ------
        ConfigError, BusyError
            The data folder cannot be used, or another rig is using it.
        """
        work = self._tasks.work
        try:
            await work(self._store.make_folders)
            self._folder_lock = await work(self._machine.disk.lock, self._data_dir)
        except OSError as error:
            raise ConfigError(f"data_dir: {error.filename or self._data_dir}: {error.strerror}") from None
        await self._poses.recall()
        await self._result.recall()
        self._pair.rescale(self._poses.scale)
        remembered, reason = await self._latch.read()
        for event in await work(self._store.recover, "the rig process died during the test"):
            remembered = "running"
            self.finished = event
            self._publish(event)
        before = None
        await self._rest.recall(in_doubt=remembered == "running")  # after a crash the last pulse's time is unknown
        if remembered == "running":
            before, reason = "uncertain", f"the rig died during a test ({reason or 'its journal was left'})"
        elif remembered == "latched":
            before = "latched"
        trial = Trial().connected(before, reason)
        try:
            await self._pair.connect()
        except DeviceError as error:
            log.error("%s", error)
            trial = trial.disconnected(str(error))  # a latch stays although a device is missing
        else:
            if before == "uncertain":
                trial = replace(trial, reason=f"{reason}; the stimulator, asked now: {self._pair.found_state}")
        self._change(trial)

    async def close(self) -> None:
        """Stop a running test, wait until it is sealed, disconnect. A start that is under way does not begin."""
        self._closing = True
        self._change(self._trial.disconnected("the rig is shutting down"))
        await self.stop("the rig is shutting down", "rig", latch_idle=False)
        if self._playing is not None:
            await self._tasks.sleep(SEALED_WITHIN_S, self._playing.done)
        await self._pair.disconnect()
        await self._latch_written()  # of a stop that came meanwhile
        self._folder_lock.__exit__(None, None, None)

    async def start(self, request: TestPlan, key: str = "") -> Status:
        """Start a test; `key` is what extensions of an adaptive test must know.

        Raises
        ------
        BusyError, LatchedError, UncertainError, DeviceError
            See `Trial.start`.
        PlanError, RefusedError
            The plan is wrong, or outside a limit.
        LatchChangedError, WithdrawnError
            The rig was stopped, or this test withdrawn, while this waited.
        JournalError, RigError
            The journal or the latch file cannot be written.
        """
        self._trial.may_start()  # before its turn: a start that was asked for while stopped must not run later
        latch = self.latch
        if request.angle is not None and self._has_angle:
            await await_angle(self._angle_receiver(), self._tasks)
        async with self._in_turn():
            self._trial.may_start()
            self._refuse_unseen(latch)
            check_names("plan", test_id=request.test_id, participant=request.participant)
            if request.adaptive is not None and len(key) < MIN_KEY:  # only who started it extends it
                raise PlanError(
                    f"start.key: an adaptive test needs one of at least {MIN_KEY} characters; make a random one"
                )
            table = limits.for_plan(self._table, request)
            test = await self._tasks.work(plan.build, request, table)
            await self._tasks.work(self._store.check_room, request.test_id)
            following = self._trial.start(request.test_id, request.participant)  # a stop may have come meanwhile
            now_s, longest_s = self._clock.unix_s(), test.longest_s / self._clock.speed
            needs_widths = self._require_calibration and request.kind != PASSIVE  # no pulse, so no width to find
            check_profile(request.profile, now_s, needs_widths, longest_s)
            check_range(request, self.angle_set_at_utc)
            plan.check_steps(test, self._pair.steps)
            self._rest.check(test, table["rest_between_tests_s"])
            self._check_angle(request, table)
            self._key = key
            if (withdrawn := self._withdrawn.get(request.test_id)) is not None:
                raise WithdrawnError(f"test {request.test_id}: {withdrawn}; ask for a new test")
            # nothing is waited for from here until it can be halted
            await self._launch(test, table, following)
        return self.status()

    @property
    def angle_set_at_utc(self) -> str | None:
        """When the angle sensor was calibrated; None: it was not. May be called from another thread."""
        found = self._poses.calibration
        return None if found is None else found.set_at_utc

    async def angle_pose(self, request: AnglePoseRequest) -> Status:
        """The goniometer's angle of a joint that is held still; the second one completes a calibration.

        Raises
        ------
        PlanError
            This rig has no angle sensor.
        BusyError
            A test is in progress.
        DeviceError, RefusedError, RigError
            See `AngleCalibrating.pose`.
        """
        async with self._in_turn():
            if not self._has_angle:
                raise PlanError(NO_SENSOR.format("angle_pose"))
            if self._trial.busy:
                raise BusyError(f"test {self._trial.test_id} is {self._trial.state}; take the pose afterwards")
            await self._poses.pose(
                request.angle_rad, request.by, self._angle_receiver(), self._table["angle_rad"], request.first
            )
            self._pair.rescale(self._poses.scale)
            self._publish(StateEvent(status=self.status()))
        return self.status()

    def _check_angle(self, plan: TestPlan, table: dict[str, Limit]) -> None:
        """Refuse a test that asks for an angle that this rig cannot give, or where the joint is elsewhere."""
        if plan.angle is None:
            return
        if not self._has_angle:
            raise PlanError(NO_SENSOR.format("plan.angle"))
        if self._require_calibration and self._poses.calibration is None:
            raise RefusedError(
                "plan.angle: the angle sensor is not calibrated; take two poses with a goniometer, "
                f"{degrees(APART_RAD)} or more apart"
            )
        check_start(self._angle_receiver(), plan, table, self._clock)

    async def library(self) -> Sequences:
        """All sequences and protocols that a plan may name."""
        return await self._tasks.work(plan.library)

    async def stop(self, reason: str, by: str, latch_idle: bool = True) -> StopEvidence:
        """Stop stimulation now, latch, and return what device and torque showed afterwards."""
        words = f"{reason:.{LONGEST_WORDS}} (by {by:.{LONGEST_WORDS}})" if by else f"{reason:.{LONGEST_WORDS}}"
        until_s = self._clock.now_s() + STORED_S * self._clock.speed
        if self._end("stopped", words, latch_idle):
            await self._tasks.sleep(STOP_TIMEOUT_S, self._evidence_ready)
            if self._trial.state == "sealing":
                await self._latch_written(until_s)
            if self._evidence is not None or self._trial.busy:
                return self._evidence or self._unconfirmed("no more pulses are sent; the device did not answer in time")
        evidence = await self._stop_idle()
        await self._latch_written(until_s)
        return evidence

    async def _latch_written(self, until_s: float = math.inf) -> None:
        """Wait until what the next process has to know of the last stop is stored, or the disk refused it, or hangs."""
        if self._latching is not None:
            await self._tasks.wait(until_s, self._latching.done)

    async def _stop_idle(self) -> StopEvidence:
        """Ask the device although no test runs."""
        gate = self._pair.gate
        if gate is None:
            return self._unconfirmed("the stimulator is not connected; no pulse can be sent")
        try:
            await gate.stop()
            safe, state = await gate.state()
        except DeviceError as error:
            return self._unconfirmed(str(error))
        await self._rest.settle()
        return StopEvidence(confirmed=safe, detail=f"no test was running; device: {state}", device_state=state)

    def _unconfirmed(self, detail: str) -> StopEvidence:
        """Evidence if the device did not answer: a pulse that was sent before may still be felt."""
        possible = self._pair.gate.still_possible() if self._pair.gate else self._rest.doubt()
        words = "; ".join(part for part in (detail, possible) if part)
        return StopEvidence(confirmed=False, detail=words, pulse_may_follow=bool(possible))

    async def rearm(self, by: str, latch: str) -> Status:
        """A person has checked participant and rig: ask both devices again, then be ready.

        Raises
        ------
        BusyError
            A test is in progress.
        LatchChangedError
            The rig was stopped since that person was shown `latch`, before this or meanwhile.
        DeviceError
            A device does not answer: the rig stays stopped.
        """
        async with self._in_turn():
            self._refuse_unseen(latch)
            stopped = self._trial
            following = stopped.rearm()
            if stopped.lost or not await self._pair.both_answer():
                try:
                    await self._pair.reconnect()
                except DeviceError as error:
                    self._change(self._trial.disconnected(str(error)))
                    raise
            for event in await self._tasks.work(self._store.recover, "its recording could not be sealed at its end"):
                self.finished = event
                self._publish(event)
            await self._rest.settle()
            self._refuse_unseen(latch)
            await self._latch.clear()
            try:
                self._refuse_unseen(latch)
            except LatchChangedError:
                await self._remember(self._trial)
                raise
            log.info("re-armed by %s after: %s", by, stopped.reason)
            self._change(following)
        return self.status()
