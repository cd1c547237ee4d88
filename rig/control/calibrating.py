"""Requests of a guided calibration; `stimrig.rig.control.calibration` decides what is allowed, `Playing` plays it."""

from __future__ import annotations

import logging

from stimrig.rig import plan
from stimrig.rig.control.calibration import Calibration
from stimrig.rig.control.playing import Playing, check_names
from stimrig.rig.errors import BusyError, PlanError
from stimrig.rig.messages import (
    Calibrated,
    CalibrateFinishRequest,
    CalibrateStartRequest,
    CalibrationResult,
    StateEvent,
    Status,
    Threshold,
)

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
            self._result.refuse_waiting()
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

    async def calibrate_finish(self, request: CalibrateFinishRequest) -> CalibrationResult:
        """Close the calibration and give its profile; of one that is closed, what was kept of it.

        Raises PlanError (a threshold is missing, none or another is open), BusyError, RefusedError (its day is over),
        RigError (the result could not be written: it stays open).
        """
        async with self._in_turn():
            if self._calibration is None and (kept := self._result.of(request.calibration_id)) is not None:
                result = kept.result
                if request.discard:
                    await self._result.let_go(kept.calibration_id)
                    result = result.model_copy(update={"profile": None})
            else:
                result = await self._close_calibration(self._open_calibration(request.calibration_id), request.discard)
            log.info("calibration %s by %s", "discarded" if request.discard else "done", request.by)
            self._publish(StateEvent(status=self.status()))
        return result

    async def _close_calibration(self, calibration: Calibration, discard: bool) -> CalibrationResult:
        of = calibration.request
        profile = None if discard else calibration.profile(self._clock.unix_s())
        result = CalibrationResult(profile=profile, recordings=calibration.recordings)
        if not discard:
            found = {"calibration_id": of.calibration_id, "participant": of.participant, "by": of.by, "result": result}
            await self._result.keep(Calibrated.model_validate(found))
        if self._trial.state == "calibrating":  # a stop may have come meanwhile: it takes no result back
            self._change(self._trial.calibrated())
        return result

    async def calibrate_stored(self, calibration_id: str) -> Status:
        """A client has stored that result. Raises RigError: the file could not be removed, so it waits still."""
        async with self._in_turn():
            await self._result.let_go(calibration_id)
            self._publish(StateEvent(status=self.status()))
        return self.status()

    def _open_calibration(self, calibration_id: str = "") -> Calibration:
        if self._calibration is None:
            raise PlanError("calibration: none is open (a stop or a fault closes it); start a new one")
        open_id = self._calibration.request.calibration_id
        if calibration_id not in ("", open_id):
            raise PlanError(f"calibration: {calibration_id!r} is not open; {open_id} is")
        if self._trial.state != "calibrating":
            raise BusyError(f"calibration: train {self._trial.test_id} is {self._trial.state}; wait or stop it")
        return self._calibration
