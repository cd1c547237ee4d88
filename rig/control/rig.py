"""The rig: both devices, one test at a time, its status and events. Independent of the sockets."""

from __future__ import annotations

import logging
from dataclasses import replace

from rig import limits, plan
from rig.control.calibration import check_profile
from rig.control.extending import check_key
from rig.control.playing import check_names
from rig.control.posing import Posing
from rig.errors import DeviceError
from rig.messages import PASSIVE, Status, StopEvidence, TestPlan
from rig.trial import Trial

log = logging.getLogger("rig")

STOP_TIMEOUT_S = 6.0
"""Real seconds to wait for the evidence of a stop, including the fall of the torque."""


class Rig(Posing):
    """Owns the devices. All methods may be called from any thread.

    Parameters
    ----------
    publish
        Receives all events except live ones; called from any thread, must not block.

    Raises
    ------
    ConfigError, BusyError
        The data folder cannot be used, or another rig is using it.
    """

    def open(self) -> None:
        """Seal what a crash left, then connect; a missing device is reported in the status, not raised."""
        remembered, reason = self._latch.read()
        for event in self._store.recover("the rig process died during the test"):
            remembered = "running"
            self.finished = event
            self._publish(event)
        before = None
        self._rest.recall(in_doubt=remembered == "running")  # after a crash the last pulse's time is unknown
        if remembered == "running":
            before, reason = "uncertain", f"the rig died during a test ({reason or 'its journal was left'})"
        elif remembered == "latched":
            before = "latched"
        trial = Trial().connected(before, reason)
        try:
            self._pair.connect()
        except DeviceError as error:
            log.error("%s", error)
            trial = trial.disconnected(str(error))  # a latch stays although a device is missing
        else:
            if before == "uncertain":
                trial = replace(trial, reason=f"{reason}; the stimulator, asked now: {self._pair.found_state}")
        self._change(trial)

    def close(self) -> None:
        """Stop a running test, wait until it is sealed, disconnect."""
        self.stop("the rig is shutting down", "rig", latch_idle=False)
        thread = self._thread
        if thread is not None:
            thread.join(timeout=30)
        self._pair.disconnect()
        self._folder_lock.close()

    def start(self, request: TestPlan, key: str = "") -> Status:
        """Start a test in its own thread; `key` is what extensions of an adaptive test must know.

        Raises
        ------
        BusyError, LatchedError, UncertainError, DeviceError
            See `Trial.start`.
        PlanError, RefusedError
            The plan is wrong, or outside a limit.
        JournalError, RigError
            The journal or the latch file cannot be written.
        """
        self._trial.may_start()  # before the lock: a start that was asked for while stopped must not run later
        self._await_angle(request)
        with self._lock:
            self._trial.may_start()
            check_names("plan", test_id=request.test_id, participant=request.participant)
            check_key(request, key)
            table = limits.for_plan(self._table, request)
            test = plan.build(request, table)
            now_s, longest_s = self._clock.unix_s(), test.longest_s / self._clock.speed
            needs_widths = self._require_calibration and request.kind != PASSIVE  # no pulse, so no width to find
            check_profile(request.profile, now_s, needs_widths, longest_s)
            plan.check_steps(test, self._pair.steps)
            self._rest.check(test, table["rest_between_tests_s"])
            self._check_angle(request, table)
            self._store.check_room(request.test_id)
            self._key = key
            self._launch(test, table, self._trial.start(request.test_id, request.participant))
        return self.status()

    def stop(self, reason: str, by: str, latch_idle: bool = True) -> StopEvidence:
        """Stop stimulation now, latch, and return what device and torque showed afterwards."""
        words = f"{reason} (by {by})" if by else reason
        if self._end("stopped", words, latch_idle):
            self._evidence_ready.wait(STOP_TIMEOUT_S)
            return self._evidence or self._unconfirmed("no more pulses are sent; the device did not answer in time")
        gate = self._pair.gate
        if gate is None:
            return StopEvidence(confirmed=False, detail="the stimulator is not connected; no pulse can be sent")
        try:
            gate.stop()
            safe, state = gate.state()
        except DeviceError as error:
            return self._unconfirmed(str(error))
        self._rest.settle()
        return StopEvidence(confirmed=safe, detail=f"no test was running; device: {state}", device_state=state)

    def _unconfirmed(self, detail: str) -> StopEvidence:
        """Evidence if the device did not answer: a pulse that was sent before may still be felt."""
        possible = self._pair.gate.still_possible() if self._pair.gate else ""
        words = "; ".join(part for part in (detail, possible) if part)
        return StopEvidence(confirmed=False, detail=words, pulse_may_follow=bool(possible))

    def rearm(self, by: str) -> Status:
        """A person has checked participant and rig: ask both devices again, then be ready.

        Raises
        ------
        BusyError
            A test is in progress.
        DeviceError
            A device does not answer: the rig stays stopped.
        """
        with self._lock:
            following = self._trial.rearm()
            if self._trial.lost or not self._pair.both_answer():
                try:
                    self._pair.reconnect()
                except DeviceError as error:
                    self._change(self._trial.disconnected(str(error)))
                    raise
            for event in self._store.recover("its recording could not be sealed at its end"):
                self.finished = event
                self._publish(event)
            self._rest.settle()
            self._latch.clear()
            log.info("re-armed by %s after: %s", by, self._trial.reason)
            self._change(following)
        return self.status()
