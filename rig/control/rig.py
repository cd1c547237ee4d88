"""The rig: both devices, one test at a time, and what is told about it. Knows no socket."""

from __future__ import annotations

import logging
import math
import re
import threading
import time
from collections.abc import Callable

from rig import limits, plan
from rig.acquire.halt import Cause, Halt
from rig.acquire.run import LEAD_S, TestRun
from rig.clock import Clock
from rig.config import RigConfig
from rig.control.calibration import Calibration, check_profile
from rig.control.latch import Latch, Remembered, lock_folder
from rig.control.live import live_event
from rig.control.pair import Pair
from rig.control.sealing import Shelf
from rig.errors import BusyError, ConfigError, DeviceError, JournalError, PlanError, RefusedError, RigError
from rig.messages import (
    CalibrateStartRequest,
    CalibrationResult,
    Event,
    FinishedEvent,
    LiveEvent,
    Preview,
    PreviewRequest,
    StateEvent,
    Status,
    StopEvidence,
    TestPlan,
    Threshold,
)
from rig.trial import Trial

log = logging.getLogger("rig")

_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")
STOP_TIMEOUT_S = 6.0
"""Real seconds to wait for the evidence of a stop, decay of the torque included."""
HUNG_S = 5.0
"""Real seconds without a sign of the sender: it asks for proof of health at every pulse's time, 1 s apart at most."""
LOCK_PATIENCE_S = 0.2
LONGEST_REQUEST_S = 60.0
"""Real seconds that a request may take: re-arming opens both devices anew and seals what a full disk had left."""


class Rig:
    """Owns the devices. Every method may be called from any thread.

    Parameters
    ----------
    publish
        Takes every event but the live ones; called from any thread, must not block.

    Raises
    ------
    ConfigError, BusyError
        The data folder cannot be used, or another rig uses it.
    """

    def __init__(self, config: RigConfig, clock: Clock, publish: Callable[[Event], None]) -> None:
        self._watch = config.watch.watch()
        self._clock = clock
        self._publish = publish
        self._table = config.limits.table()
        self._require_calibration = config.require_calibration
        self._shelf = Shelf(config, clock)
        try:
            self._shelf.make_folders()
            self._folder_lock = lock_folder(config.data_dir)
        except OSError as error:
            raise ConfigError(f"data_dir: {error.filename or config.data_dir}: {error.strerror}") from None
        self._latch = Latch(config.data_dir)
        self._lock = threading.RLock()
        self._trial = Trial()
        self._pair = Pair(config, clock, self._fault, self._lost)
        self._halt: Halt | None = None
        self._run: TestRun | None = None
        self._thread: threading.Thread | None = None
        self._evidence: StopEvidence | None = None
        self._told = threading.Event()
        self._next_live_pulse = 0
        self._calibration: Calibration | None = None
        self._last_pulse_s: float | None = None
        self._held_since_s: float | None = None
        self._born_s = clock.now_s()
        self.finished: FinishedEvent | None = None

    def open(self) -> None:
        """Recover what a crash left, then connect; a device that is not there is told, not raised."""
        remembered, reason = self._latch.read()
        for event in self._shelf.recover("the rig process died during the test"):
            remembered = "running"
            self.finished = event
            self._publish(event)
        before = None
        if remembered == "running":
            before, reason = "uncertain", f"the rig died during a test ({reason or 'its journal was left'})"
        elif remembered == "latched":
            before = "latched"
        trial = Trial().connected(before, reason)
        try:
            self._pair.connect()
        except DeviceError as error:
            log.error("%s", error)
            trial = trial.disconnected(str(error))  # a latch outlives the missing device
        self._change(trial)

    def close(self) -> None:
        """Stop what runs, wait until it is sealed, disconnect."""
        self.stop("the rig is shutting down", "rig", latch_idle=False)
        thread = self._thread
        if thread is not None:
            thread.join(timeout=30)
        self._pair.disconnect()
        self._folder_lock.close()

    def status(self) -> Status:
        """How things stand now."""
        with self._lock:
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
            reason=trial.reason if trial.lost in trial.reason else f"{trial.reason}; {trial.lost}".lstrip("; "),
            test_id=trial.test_id,
            participant=trial.participant,
            segment=run.segment() if run else None,
            elapsed_s=elapsed_s,
            duration_s=run.test.duration_s if run else 0.0,
            stimulator=self._pair.identity["stimulator"],
            load_cell=cell,
            torque_age_s=receiver.age_s(self._clock.now_s()) if receiver and seen else None,
            torque_nm=torque_nm if torque_nm is not None and math.isfinite(torque_nm) else None,
            calibration=calibration,
            finished=self.finished,
        )

    def trouble(self) -> str | None:
        """What should live in this process and does not; None: all of it does. For the process's own watchdog."""
        if self._lock.acquire(timeout=LOCK_PATIENCE_S):
            self._lock.release()
            self._held_since_s = None
        else:
            now_s = time.monotonic()
            since_s = self._held_since_s = self._held_since_s or now_s
            if now_s - since_s > LONGEST_REQUEST_S:
                return f"a request has not come to its end for {now_s - since_s:.0f} s"
        trial, run, thread, receiver = self._trial, self._run, self._thread, self._pair.receiver
        if run is not None and run.sender_age_s() > HUNG_S:
            return f"the sender hangs: it has asked for nothing for {run.sender_age_s():.0f} s"
        if trial.busy and not (thread is not None and (thread.is_alive() or thread.ident is None)):
            return f"the thread of test {trial.test_id} has ended without an end"
        if receiver is not None and not receiver.living and trial.state != "disconnected" and not trial.lost:
            return "the torque receiver's thread has ended"
        return None

    def preview(self, request: PreviewRequest) -> Preview:
        """Duration, dose and pulses of a plan. Raises PlanError, RefusedError."""
        check_profile(request.plan.profile, self._clock.unix_s(), required=False)
        table = limits.for_plan(self._table, request.plan)
        return plan.preview(plan.build(request.plan, table), request.recruitment)

    def live(self) -> LiveEvent | None:
        """The newest torque and pulses; None where nothing came since the last call."""
        with self._lock:
            run, receiver, now_s = self._run, self._pair.receiver, self._clock.now_s()
            if receiver is None:
                return None
            origin_s = run.t0_s if run and run.t0_s is not None else self._born_s
            event = live_event(receiver, run, origin_s, now_s, self._next_live_pulse)
            if event is not None:
                self._next_live_pulse += len(event.pulse_time_s)
            return event

    def start(self, request: TestPlan) -> Status:
        """Begin a test in its own thread.

        Raises
        ------
        BusyError, LatchedError, UncertainError, DeviceError
            See `Trial.start`.
        PlanError, RefusedError
            The plan is wrong or outside a limit.
        JournalError, RigError
            The disk refuses the journal or the latch file.
        """
        with self._lock:
            self._trial.may_start()
            _check_names("plan", test_id=request.test_id, participant=request.participant)
            check_profile(request.profile, self._clock.unix_s(), self._require_calibration)
            table = limits.for_plan(self._table, request)
            test = plan.build(request, table)
            self._check_rest(test, table["rest_between_tests_s"])
            self._shelf.check_room(request.test_id)
            self._launch(test, table, self._trial.start(request.test_id, request.participant))
        return self.status()

    def calibrate(self, request: CalibrateStartRequest) -> Status:
        """Open a guided calibration; nothing is sent yet.

        Raises
        ------
        BusyError, LatchedError, UncertainError, DeviceError
            As for a test.
        PlanError, RefusedError
            A wrong name or id; a step, train, current or rate outside the limits.
        """
        with self._lock:
            following = self._trial.calibrate(request.participant)
            _check_names("calibration", calibration_id=request.calibration_id, participant=request.participant)
            calibration = Calibration(request, self._table)
            self._shelf.check_room(f"{request.calibration_id}.001")
            self._calibration = calibration
            self._change(following)
        return self.status()

    def calibrate_step(self, direction: str) -> Status:
        """Play one train: a step up, a step down, or the same again; returns when it has begun.

        Raises
        ------
        PlanError, BusyError, RefusedError
            No calibration is open; a train is on its way; above a limit or the marked comfort maximum.
        """
        with self._lock:
            calibration = self._open_calibration()
            request = calibration.train(calibration.next_width_us(direction))
            test = plan.build(request, calibration.table)
            self._check_rest(test, calibration.table["rest_between_trains_s"])
            self._shelf.check_room(request.test_id)
            self._launch(test, calibration.table, self._trial.train(request.test_id))
        return self.status()

    def calibrate_mark(self, threshold: Threshold) -> Status:
        """Mark the last train's width as a threshold. Raises PlanError, BusyError."""
        with self._lock:
            self._open_calibration().mark(threshold)
            self._publish(StateEvent(status=self.status()))
        return self.status()

    def calibrate_finish(self, by: str, discard: bool) -> CalibrationResult:
        """Close the calibration and give its profile. Raises PlanError (a threshold is missing), BusyError."""
        with self._lock:
            calibration = self._open_calibration()
            profile = None if discard else calibration.profile(self._clock.unix_s())
            log.info(
                "calibration %s %s by %s", calibration.request.calibration_id, "discarded" if discard else "done", by
            )
            self._change(self._trial.calibrated())
        return CalibrationResult(profile=profile, recordings=calibration.recordings)

    def _open_calibration(self) -> Calibration:
        if self._calibration is None:
            raise PlanError("calibration: none is open (a stop or a fault closes it); begin with calibrate-start")
        if self._trial.state != "calibrating":
            raise BusyError(f"calibration: train {self._trial.test_id} is {self._trial.state}; wait or stop it")
        return self._calibration

    def _check_rest(self, test: plan.PlannedTest, limit: limits.Limit) -> None:
        """Time enough between the last pulse that was sent and the first that is planned?"""
        if self._last_pulse_s is None or not (test.pulse_width_us > 0).any():
            return
        first_s = float((test.pulse_width_us > 0).argmax()) / test.plan.pulse_rate_hz + LEAD_S * self._clock.speed
        rest_s = self._clock.now_s() + first_s - self._last_pulse_s
        refusal = limits.check(limit, rest_s)
        if refusal is not None:
            raise RefusedError(f"plan: {refusal}; wait {limit.lo - rest_s:.1f} s")

    def _launch(self, test: plan.PlannedTest, table: dict[str, limits.Limit], following: Trial) -> None:
        """Journal, latch file, thread: what every test and every train of a calibration goes through."""
        self._latch.write("running", f"test {following.test_id} of participant {following.participant}")
        try:
            self._begin(test, table)
        except JournalError:
            self._latch.clear()
            raise
        self._change(following)
        assert self._thread is not None
        self._thread.start()

    def _begin(self, test: plan.PlannedTest, table: dict[str, limits.Limit]) -> None:
        gate, receiver = self._pair.gate, self._pair.receiver
        assert gate is not None
        assert receiver is not None
        journal = self._shelf.begin(test, self._pair.identity)
        halt = Halt(self._clock)
        run = TestRun(test, table, journal, gate, receiver, self._clock, halt, self._watch)
        halt.on_set(lambda: self._halted(halt.reason))
        self._halt, self._run, self._evidence = halt, run, None
        self._told.clear()
        self._next_live_pulse = 0
        self._thread = threading.Thread(target=self._execute, args=(run,), name="test", daemon=True)

    def stop(self, reason: str, by: str, latch_idle: bool = True) -> StopEvidence:
        """Stop stimulation now, latch, and say what the device and the torque tell of it."""
        words = f"{reason} (by {by})" if by else reason
        if self._end("stopped", words, latch_idle):
            self._told.wait(STOP_TIMEOUT_S)
            late = StopEvidence(confirmed=False, detail="no pulse leaves; the device did not answer in time")
            return self._evidence or late
        gate = self._pair.gate
        if gate is None:
            return StopEvidence(confirmed=False, detail="the stimulator is not connected; no pulse can leave")
        try:
            gate.stop()
            safe, state = gate.state()
        except DeviceError as error:
            return StopEvidence(confirmed=False, detail=str(error))
        return StopEvidence(confirmed=safe, detail=f"no test was running; device: {state}", device_state=state)

    def rearm(self, by: str) -> Status:
        """A person has looked: ask both devices anew and be ready.

        Raises
        ------
        BusyError
            A test is on its way.
        DeviceError
            A device does not answer: the rig stays as it is.
        """
        with self._lock:
            following = self._trial.rearm()
            if self._trial.lost or not self._pair.both_answer():
                try:
                    self._pair.reconnect()
                except DeviceError as error:
                    self._change(self._trial.disconnected(str(error)))
                    raise
            for event in self._shelf.recover("its recording could not be sealed at its end"):
                self.finished = event
                self._publish(event)
            self._latch.clear()
            log.info("re-armed by %s after: %s", by, self._trial.reason)
            self._change(following)
        return self.status()

    def _fault(self, reason: str) -> None:
        """A device says that something is wrong, from one of its threads."""
        log.error("%s", reason)
        self._end("fault", reason)

    def _lost(self, reason: str) -> None:
        """A device is gone, from one of its threads."""
        log.error("%s", reason)
        self._end("fault", reason, latch_idle=False)
        with self._lock:
            self._change(self._trial.disconnected(reason))

    def _end(self, cause: Cause, reason: str, latch_idle: bool = True) -> bool:
        """End the test that runs, or latch; True if one runs. Takes the lock only when idle: a stop must not wait."""
        halt = self._halt
        if not (self._trial.busy and halt is not None):
            with self._lock:  # a start may be on its way, and must then be ended, too
                halt = self._halt if self._trial.busy else None
                if halt is None and latch_idle:
                    self._halted(reason)
        if halt is not None:
            halt.set(cause, reason)
        return halt is not None

    def _remember(self, state: Remembered, reason: str) -> None:
        """Write the latch file; where the disk refuses, the rig stays stopped all the same, and what the file says
        since the test's start ("running") makes the next start uncertain."""
        try:
            self._latch.write(state, reason)
        except RigError as error:
            log.error("%s", error)

    def _halted(self, reason: str) -> None:
        with self._lock:
            following = self._trial.halted(reason)
            if following.state == "latched":
                self._remember("latched", reason)
            self._change(following)

    def _change(self, trial: Trial) -> None:
        with self._lock:
            changed = trial != self._trial
            self._trial = trial
            if not trial.calibrating:
                self._calibration = None  # a stop, a fault or a lost device closes it
        if changed:
            log.info("state %s %s", trial.state, trial.reason, extra={"test_id": trial.test_id})
            self._publish(StateEvent(status=self.status()))

    def _execute(self, run: TestRun) -> None:
        threading.Thread(target=self._announce, args=(run,), name="announce", daemon=True).start()
        try:
            result = run.execute()
            self._evidence = result.evidence
            self._told.set()
            with self._lock:
                self._change(self._trial.ended())
            finished = self._shelf.finish(run.journal_path, run.test.plan.test_id, result)
        except Exception as error:  # a mistake in this program: stay stopped, keep the journal for the next start
            log.exception("the test could not be ended in order")
            self._broken(f"internal: {type(error).__name__}: {error}")
            return
        with self._lock:
            self._run = None
            self._last_pulse_s = result.last_pulse_s or self._last_pulse_s
            train = self._trial.calibrating
            if train and self._calibration is not None:
                self._calibration.played(run.test.plan.profile.max_pulse_width_us, result.rise_nm, finished)
            if not train:
                self.finished = finished
            if finished.recording_path is None and run.t0_s is not None:  # kept as a journal: a person must see to it
                self._change(self._trial.halted(finished.reason))
            following = self._trial.sealed()
            if following.state == "latched":
                self._remember("latched", following.reason)
            else:
                self._latch.clear()
            self._change(following)
        if not train:
            self._publish(finished)

    def _broken(self, reason: str) -> None:
        with self._lock:
            self._run = None
            self._remember("running", reason)
            self._change(Trial("latched", reason, lost=reason))
        self._told.set()

    def _announce(self, run: TestRun) -> None:
        """Tell that the test runs, from outside the thread that must be on time."""
        while not run.started.wait(0.05):
            if run.stimulation_ended.is_set():
                return
        with self._lock:
            if self._trial.state == "arming":
                self._change(self._trial.armed())


def _check_names(place: str, **names: str) -> None:
    for name, value in names.items():
        if not _NAME.match(value):
            raise PlanError(f"{place}.{name}: {value!r} must be letters, digits, '.', '_' or '-', at most 100")
