"""The rig: its devices, one test at a time, its status and events. Independent of the sockets."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

from pydantic import BaseModel, TypeAdapter

from stimrig.rig import limits, plan
from stimrig.rig.config import RigConfig
from stimrig.rig.control.angle_calibration import Joint
from stimrig.rig.control.calibrating import Calibrations
from stimrig.rig.control.calibration import check_profile, check_range
from stimrig.rig.control.live import finite, live_event
from stimrig.rig.control.memory import LatchFile, Rest, Result
from stimrig.rig.control.pair import Pair
from stimrig.rig.control.playing import LONGEST_WORDS, Player, check_names
from stimrig.rig.control.replies import refusal
from stimrig.rig.control.sealing import RecordingStore
from stimrig.rig.control.state import State
from stimrig.rig.errors import BusyError, ConfigError, DeviceError, LatchChangedError, PlanError, RigError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import (
    PASSIVE,
    Event,
    LiveEvent,
    Preview,
    Reply,
    Sequences,
    StateEvent,
    Status,
    StopEvidence,
    TestPlan,
)
from stimrig.rig.phase import NO_PREVIEW, Phase
from stimrig.rig.requests import AnglePoseRequest, PreviewRequest, Request
from stimrig.rig.tasks import Turn

log = logging.getLogger("rig")

MIN_KEY = 16
STOP_TIMEOUT_S = 6.0
"""Real seconds to wait for the evidence of a stop, including the fall of the torque."""
STORED_S = 7.0
"""Real seconds after which a stop is answered although the disk has not taken its latch."""
MOST_PREVIEWS = 8
"""That wait at once; each takes up to a third of a second."""
SEALED_WITHIN_S = 30.0
"""Real seconds within which a test that was stopped is sealed."""


class Rig:
    """Its parts, and what needs several of them. All but `status`, `trouble` and `live` are tasks of the machine.

    `publish`: receives all events except live ones; must not block.
    """

    def __init__(self, config: RigConfig, machine: Machine, publish: Callable[[Event], None]) -> None:
        self._data_dir, self._require_calibration = config.data_dir, config.require_calibration
        self._machine, self._tasks, self._clock = machine, machine.tasks, machine.tasks.clock
        self._publish, self.speed = publish, machine.tasks.clock.speed
        self.table = config.limits.table()
        """Hard limits, narrowed by the rig file."""
        self._born_s, self._previews, self._preview_turn = self._clock.now_s(), 0, Turn(machine.tasks)
        self.state = State(
            LatchFile(config.data_dir, machine), machine.tasks, machine.new_id()[:8], self._publish_status
        )
        self.pair = Pair(config, machine, self.fault, self._lost)
        self.joint = Joint(config, machine, self.pair, self.table["angle_rad"])
        self.rest = Rest(config.data_dir, machine)
        self.store = RecordingStore(config, machine)
        self._result = Result(config.data_dir, machine)
        self.player = Player(self.state, self.pair, self.joint, self.rest, self.store, machine, config.watch, publish)
        self.calibrations = Calibrations(self.player, self._result, self.table, self._publish_status)

    def status(self) -> Status:
        phase, run, receiver = self.state.phase, self.player.run, self.pair.receiver
        calibration = self.state.calibration
        cell = dict(self.pair.identity["load_cell"])
        if receiver and (measured_hz := receiver.measured_rate_hz()) is not None:
            cell["measured_rate_hz"] = round(measured_hz, 2)
        has_samples = receiver is not None and receiver.last_s is not None
        stimulator = self.pair.identity["stimulator"]
        return Status(
            state=phase.state,
            reason=phase.reason_stopped,
            latch=self.state.latch,
            test_id=phase.test_id,
            participant=phase.participant,
            segment=run.segment() if run else None,
            elapsed_s=run.elapsed_s() if run else 0.0,
            duration_s=run.score.longest_s if run else 0.0,
            stimulator=stimulator and {**stimulator, "shortest_us": self.pair.steps.shortest_us},
            load_cell=cell,
            torque_age_s=receiver.age_s(self._clock.now_s()) if receiver and has_samples else None,
            torque_nm=finite(receiver.last_torque_nm) if receiver else None,
            angle=self.joint.status(),
            calibration=calibration.status() if calibration else None,
            calibrated=self._result.waiting,
            limits=limits.bounds(self.table),
            require_calibration=self._require_calibration,
            finished=self.player.finished,
        )

    def trouble(self) -> str | None:
        """Return the task or request of this process that hangs or has died, or None. For the process's watchdog."""
        phase, receiver = self.state.phase, self.pair.receiver
        if (trouble := self.state.trouble() or self.player.trouble()) is not None:
            return trouble
        if receiver is not None and not receiver.living and phase.state != "disconnected" and not phase.lost:
            return "the torque receiver has ended"
        return None

    def take_live(self) -> LiveEvent | None:
        """Torque, angle and pulses since the last call; None if there is no new torque.

        It only reads, and takes what waits to be shown: it may be called from another thread than the tasks'.
        """
        run, receiver, now_s = self.player.run, self.pair.receiver, self._clock.now_s()
        if receiver is None:
            return None
        if run is None or run.t0_s is None:  # until a test's clock runs nothing has a time on it
            return live_event(receiver, None, self._born_s, now_s, self.pair.angle)
        return live_event(receiver, run, run.t0_s, now_s, self.pair.angle)

    async def open(self) -> None:
        """Seal what a crash left, then connect; a missing device is reported in the status, not raised.

        Raises ConfigError, BusyError: the data folder cannot be used, or another rig is using it.
        """
        work = self._tasks.work
        try:
            await work(self.store.make_folders)
            self._folder_lock = await work(self._machine.disk.lock, self._data_dir)
        except OSError as error:
            raise ConfigError(f"data_dir: {error.filename or self._data_dir}: {error.strerror}") from None
        await self.joint.recall()
        await self._result.recall()
        remembered, reason = await self.state.file.read()
        if await self._recover("the rig process died during the test"):
            remembered = "running"
        before = None
        await self.rest.recall(in_doubt=remembered == "running")  # after a crash the last pulse's time is unknown
        if remembered == "running":
            before, reason = "uncertain", f"the rig died during a test ({reason or 'its journal was left'})"
        elif remembered == "latched":
            before = "latched"
        phase = Phase().connected(before, reason)
        try:
            await self.pair.connect()
        except DeviceError as error:
            log.error("%s", error)
            phase = phase.disconnected(str(error))  # a latch stays although a device is missing
        else:
            if before == "uncertain":
                phase = replace(phase, reason=f"{reason}; the stimulator, asked now: {self.pair.found_state}")
        self.state.change(phase)

    async def close(self) -> None:
        """Stop a running test, wait until it is sealed, disconnect. A start that is under way does not begin."""
        self.state.closing = True
        self.state.change(self.state.phase.disconnected("the rig is shutting down"))
        await self.stop("the rig is shutting down", "rig", latch_idle=False)
        if self.player.playing is not None:
            await self._tasks.sleep(SEALED_WITHIN_S, self.player.playing.done)
        await self.pair.disconnect()
        await self.state.written()  # of a stop that came meanwhile
        self._folder_lock.__exit__(None, None, None)

    async def start(self, request: TestPlan, key: str = "") -> Status:
        """Start a test; `key` is what extensions of an adaptive test must know.

        Raises as `Phase.start`; PlanError, RefusedError: the plan is wrong, or outside a limit; LatchChangedError,
        WithdrawnError: the rig was stopped, or this test withdrawn, while this waited; JournalError, RigError: the
        journal or the latch file cannot be written.
        """
        state = self.state
        state.phase.may_start()  # before its turn: a start that was asked for while stopped must not run later
        latch = state.latch
        await self.joint.await_angle(request)
        async with state.in_turn():
            state.phase.may_start()
            state.refuse_unseen(latch)
            check_names("plan", test_id=request.test_id, participant=request.participant)
            if request.adaptive is not None and len(key) < MIN_KEY:  # only who started it extends it
                raise PlanError(
                    f"start.key: an adaptive test needs one of at least {MIN_KEY} characters; make a random one"
                )
            table = limits.for_plan(self.table, request)
            test = await self._tasks.work(plan.build, request, table)
            await self._tasks.work(self.store.check_room, request.test_id)
            following = state.phase.start(request.test_id, request.participant)  # a stop may have come meanwhile
            now_s, longest_s = self._clock.unix_s(), test.longest_s / self._clock.speed
            needs_widths = self._require_calibration and request.kind != PASSIVE  # no pulse, so no width to find
            check_profile(request.profile, now_s, needs_widths, longest_s)
            check_range(request, self.joint.set_at_utc)
            plan.check_steps(test, self.pair.steps, table["width_rise_us"])
            self.rest.check(test, table["rest_between_tests_s"])
            self.joint.check(request, table)
            self.player.refuse_withdrawn(request.test_id)
            # nothing is waited for from here until it can be halted
            await self.player.launch(test, table, following, key)
        return self.status()

    async def preview(self, request: PreviewRequest) -> Preview:
        """Build a plan that a person looks at: one at a time, and none beside a test, whose sender it would hold up.

        None in a guided calibration either: its next train would wait for it.

        Raises BusyError: a test or a calibration is in progress, or too many wait. PlanError, RefusedError: as `start`.
        """
        if self._previews >= MOST_PREVIEWS:
            raise BusyError(f"previews: {self._previews} requests are waiting; try again in a moment")
        self._previews += 1
        try:
            async with self._preview_turn, self.state.in_turn():  # a start waits for one of them, not for all
                phase = self.state.phase
                if phase.state in NO_PREVIEW:
                    activity = "a calibration" if phase.calibrating else f"test {phase.test_id}"
                    raise BusyError(f"{activity} is in progress; look at the plan afterwards")
                check_range(request.plan, self.joint.set_at_utc)
                return await self._tasks.work(self._previewed, request)
        finally:
            self._previews -= 1

    def _previewed(self, request: PreviewRequest) -> Preview:
        test = plan.build(request.plan, limits.for_plan(self.table, request.plan))
        duration_s = test.longest_s / self._clock.speed
        check_profile(request.plan.profile, self._clock.unix_s(), required=False, duration_s=duration_s)
        return plan.preview(test, request.recruitment)

    async def angle_pose(self, request: AnglePoseRequest) -> Status:
        """A pose of the angle sensor's calibration; raises as `Joint.pose`."""
        async with self.state.in_turn():
            await self.joint.pose(request, self.state.phase)
            self._publish_status()
        return self.status()

    async def library(self) -> Sequences:
        return await self._tasks.work(plan.library)

    async def stop(self, reason: str, by: str, latch_idle: bool = True) -> StopEvidence:
        """Stop stimulation now, latch, and return what device and torque showed afterwards."""
        words = f"{reason:.{LONGEST_WORDS}} (by {by:.{LONGEST_WORDS}})" if by else f"{reason:.{LONGEST_WORDS}}"
        until_s = self._clock.now_s() + STORED_S * self._clock.speed
        player, state = self.player, self.state
        halt = player.end("stopped", words, latch_idle)
        if halt is not None:
            await self._tasks.sleep(STOP_TIMEOUT_S, halt.settled)
            if state.phase.state == "sealing":
                await state.written(until_s)
            if halt.evidence is not None or state.phase.busy:
                return halt.evidence or self._unconfirmed("no more pulses are sent; the device did not answer in time")
        evidence = await self._stop_idle()
        await state.written(until_s)
        return evidence

    async def _stop_idle(self) -> StopEvidence:
        """Ask the device although no test runs."""
        gate = self.pair.gate
        if gate is None:
            return self._unconfirmed("the stimulator is not connected; no pulse can be sent")
        try:
            await gate.stop()
            safe, state = await gate.state()
        except DeviceError as error:
            return self._unconfirmed(str(error))
        await self.rest.settle()
        return StopEvidence(confirmed=safe, detail=f"no test was running; device: {state}", device_state=state)

    def _unconfirmed(self, detail: str) -> StopEvidence:
        """Evidence if the device did not answer: a pulse that was sent before may still be felt."""
        possible = self.pair.gate.still_possible() if self.pair.gate else self.rest.uncertainty()
        words = "; ".join(part for part in (detail, possible) if part)
        return StopEvidence(confirmed=False, detail=words, pulse_may_follow=bool(possible))

    async def rearm(self, by: str, latch: str) -> Status:  # noqa: ARG002 - `by` stands in the service's audit trail
        """A person has checked participant and rig: ask both devices again, then be ready.

        Raises BusyError: a test is in progress. LatchChangedError: the rig was stopped since that person was shown
        `latch`, before this or meanwhile. DeviceError: a device does not answer: the rig stays stopped.
        """
        state = self.state
        async with state.in_turn():
            state.refuse_unseen(latch)
            stopped = state.phase
            following = stopped.rearm()
            if stopped.lost or not await self.pair.both_answer():
                try:
                    await self.pair.reconnect()
                except DeviceError as error:
                    state.change(state.phase.disconnected(str(error)))
                    raise
            await self._recover("its recording could not be sealed at its end")
            await self.rest.settle()
            state.refuse_unseen(latch)
            await state.file.clear()
            try:
                state.refuse_unseen(latch)
            except LatchChangedError:
                await state.remember(state.phase)
                raise
            log.info("re-armed by a person")
            state.change(following)
        return self.status()

    async def _recover(self, reason: str) -> bool:
        """Seal the journals that were left; whether there were any."""
        recovered = await self._tasks.work(self.store.recover, reason)
        for event in recovered:
            self.player.finished = event
            self._publish(event)
        return bool(recovered)

    def fault(self, reason: str) -> None:
        log.error("%s", reason)
        self.player.end("fault", reason)

    def _lost(self, reason: str) -> None:
        log.error("%s", reason)
        self.player.end("fault", reason, latch_idle=False)
        self.state.change(self.state.phase.disconnected(reason))

    def _publish_status(self) -> None:
        self._publish(StateEvent(status=self.status()))


_REQUEST: TypeAdapter[Any] = TypeAdapter(Request)

_DO: dict[str, Callable[[Rig, Any], Awaitable[BaseModel | None]]] = {
    "start": lambda rig, request: rig.start(request.plan, request.key),
    "preview": Rig.preview,
    "stop": lambda rig, request: rig.stop(request.reason, request.by),
    "withdraw": lambda rig, request: rig.player.withdraw(request),
    "extend": lambda rig, request: rig.player.extend(request),
    "enough": lambda rig, request: rig.player.enough(request),
    "sequences": lambda rig, _: rig.library(),
    "rearm": lambda rig, request: rig.rearm(request.by, request.latch),
    "calibrate-start": lambda rig, request: rig.calibrations.start(request),
    "calibrate-step": lambda rig, request: rig.calibrations.step(request),
    "calibrate-mark": lambda rig, request: rig.calibrations.mark(request),
    "calibrate-finish": lambda rig, request: rig.calibrations.finish(request),
    "calibrate-stored": lambda rig, request: rig.calibrations.stored(request.calibration_id),
    "angle_pose": Rig.angle_pose,
}
"""Handlers of requests. A request without a handler, or whose handler returns None, is answered by the status."""


def read_request(line: bytes) -> Any:
    return _REQUEST.validate_json(line)


async def obey(rig: Rig, request: Any) -> Reply:
    """Obey a request; errors become part of the reply."""
    try:
        do = _DO.get(request.kind)
        answer = None if do is None else await do(rig, request)
        body = (rig.status() if answer is None else answer).model_dump(mode="json")
    except Exception as error:
        if not isinstance(error, RigError):
            log.exception("request %s failed", request.kind)
        return refusal(request.id, error)
    return Reply(id=request.id, ok=True, body=body)
