"""Requests of a guided calibration; `rig.control.calibration` decides what is allowed, `Playing` plays it."""

from __future__ import annotations

import logging

from rig import plan
from rig.control.calibration import Calibration
from rig.control.playing import Playing, check_names
from rig.errors import BusyError, PlanError
from rig.messages import CalibrateStartRequest, CalibrationResult, StateEvent, Status, Threshold

log = logging.getLogger("rig")


class Calibrating(Playing):
    """Opens, plays step by step, marks and closes a calibration."""

    async def calibrate(self, request: CalibrateStartRequest) -> Status:
        """Open a guided calibration; nothing is sent yet.

        Raises
        ------
        BusyError, LatchedError, UncertainError, DeviceError
            As for a test.
        PlanError, RefusedError
            Wrong name or id; step, train, current or rate outside the limits, or too small to stimulate.
        """
        latch = self.latch
        async with self._in_turn():
            following = self._trial.calibrate(request.participant)
            self._refuse_unseen(latch)
            check_names("calibration", calibration_id=request.calibration_id, participant=request.participant)
            calibration = Calibration(request, self._table, self._clock.unix_s(), self._pair.steps)
            await self._tasks.work(self._store.check_room, f"{request.calibration_id}.001")
            self._trial.may_start()  # a stop may have come meanwhile
            self._calibration = calibration
            self._change(following)
        return self.status()

    async def calibrate_step(self, direction: str, shown_us: float | None = None) -> Status:
        """Play one train: a step up, a step down, or the same again; returns when it has started.

        Raises
        ------
        PlanError, BusyError, RefusedError
            No calibration is open, or another width was shown; a train is playing; above a limit or the marked comfort
            maximum; its day is over.
        """
        async with self._in_turn():
            calibration = self._open_calibration()
            calibration.check_day(self._clock.unix_s())
            width_us = calibration.next_width_us(direction)
            calibration.check_shown(width_us, shown_us)
            request = calibration.train(width_us)
            test = plan.build(request, calibration.table)
            self._rest.check(test, calibration.rest)
            await self._tasks.work(self._store.check_room, request.test_id)
            self._open_calibration()  # a stop may have come meanwhile
            await self._launch(test, calibration.table, self._trial.train(request.test_id))
        return self.status()

    async def calibrate_mark(self, threshold: Threshold) -> Status:
        """Mark the last train's width as a threshold. Raises PlanError, BusyError, RefusedError (its day is over)."""
        async with self._in_turn():
            calibration = self._open_calibration()
            calibration.check_day(self._clock.unix_s())
            calibration.mark(threshold)
            self._publish(StateEvent(status=self.status()))
        return self.status()

    async def calibrate_finish(self, by: str, discard: bool) -> CalibrationResult:
        """Close the calibration and give its profile.

        Raises PlanError (a threshold is missing), BusyError, RefusedError (its day is over).
        """
        async with self._in_turn():
            calibration = self._open_calibration()
            profile = None if discard else calibration.profile(self._clock.unix_s())
            log.info(
                "calibration %s %s by %s", calibration.request.calibration_id, "discarded" if discard else "done", by
            )
            self._change(self._trial.calibrated())
        return CalibrationResult(profile=profile, recordings=calibration.recordings)

    def _open_calibration(self) -> Calibration:
        if self._calibration is None:
            raise PlanError("calibration: none is open (a stop or a fault closes it); start a new one")
        if self._trial.state != "calibrating":
            raise BusyError(f"calibration: train {self._trial.test_id} is {self._trial.state}; wait or stop it")
        return self._calibration
