"""Requests of a guided calibration; `rig.control.calibration` decides what is allowed, the player plays it."""

from __future__ import annotations

import logging
from collections.abc import Callable

from stimrig.rig import plan
from stimrig.rig.control.calibration import Calibration
from stimrig.rig.control.memory import Result
from stimrig.rig.control.playing import Player, check_names
from stimrig.rig.errors import BusyError, PlanError
from stimrig.rig.limits import Limit
from stimrig.rig.messages import Calibrated, CalibrationResult
from stimrig.rig.requests import (
    CalibrateFinishRequest,
    CalibrateMarkRequest,
    CalibrateStartRequest,
    CalibrateStepRequest,
)

log = logging.getLogger("rig")


class Calibrations:
    """Opens, plays step by step, marks and closes a calibration. Every answer but that of `finish` is the status."""

    def __init__(self, player: Player, result: Result, table: dict[str, Limit], publish: Callable[[], None]) -> None:
        self._player, self._result, self._table, self._publish = player, result, table, publish
        self._state, self._pair, self._rest = player.state, player.pair, player.rest
        self._store, self._tasks = player.store, player.tasks

    async def start(self, request: CalibrateStartRequest) -> None:
        """Open a guided calibration; nothing is sent yet.

        Raises BusyError, LatchedError, UncertainError, DeviceError: as for a test. PlanError, RefusedError: wrong name
        or id; step, train, current or rate outside the limits, or too small to stimulate.
        """
        state, latch = self._state, self._state.latch
        async with state.in_turn():
            following = state.phase.calibrate(request.participant)
            state.refuse_unseen(latch)
            self._result.refuse_waiting()
            check_names("calibration", calibration_id=request.calibration_id, participant=request.participant)
            calibration = Calibration(request, self._table, self._tasks.clock.unix_s(), self._pair.steps)
            await self._tasks.work(self._store.check_room, f"{request.calibration_id}.001")
            state.phase.may_start()  # a stop may have come meanwhile
            state.calibration = calibration
            state.change(following)

    async def step(self, request: CalibrateStepRequest) -> None:
        """Play one train: a step up, a step down, or the same again; returns when it has started.

        Raises PlanError, BusyError, RefusedError: no calibration is open, or another width was shown; a train is
        playing; above a limit or the marked comfort maximum; its day is over.
        """
        async with self._state.in_turn():
            calibration = self._open(today=True)
            width_us = calibration.next_width_us(request.direction)
            calibration.check_shown(width_us, request.shown_us)
            train = calibration.train(width_us)
            test = plan.build(train, calibration.table)
            self._rest.check(test, calibration.rest)
            await self._tasks.work(self._store.check_room, train.test_id)
            self._open()  # a stop may have come meanwhile
            following = self._state.phase.train(train.test_id)
            await self._player.launch(test, calibration.table, following)

    async def mark(self, request: CalibrateMarkRequest) -> None:
        """Mark the last train's width as a threshold. Raises PlanError, BusyError, RefusedError (its day is over)."""
        async with self._state.in_turn():
            self._open(today=True).mark(request.threshold)
            self._publish()

    async def finish(self, request: CalibrateFinishRequest) -> CalibrationResult:
        """Close the calibration and give its profile; of one that is closed, what was kept of it.

        Raises PlanError (a threshold is missing, none or another is open), BusyError, RefusedError (its day is over),
        RigError (the result could not be written: it stays open).
        """
        async with self._state.in_turn():
            if self._state.calibration is None and (stored := self._result.of(request.calibration_id)) is not None:
                result = stored.result
                if request.discard:
                    await self._result.let_go(stored.calibration_id)
                    result = result.model_copy(update={"profile": None})
            else:
                result = await self._close(self._open(request.calibration_id), request.discard)
            log.info("calibration %s", "discarded" if request.discard else "done")
            self._publish()
        return result

    async def stored(self, calibration_id: str) -> None:
        """A client has stored that result. Raises RigError: the file could not be removed, so it waits still."""
        async with self._state.in_turn():
            await self._result.let_go(calibration_id)
            self._publish()

    async def _close(self, calibration: Calibration, discard: bool) -> CalibrationResult:
        of = calibration.request
        profile = None if discard else calibration.profile(self._tasks.clock.unix_s())
        result = CalibrationResult(profile=profile, recordings=calibration.recordings)
        if not discard:
            kept = Calibrated(calibration_id=of.calibration_id, participant=of.participant, by=of.by, result=result)
            await self._result.store(kept)
        if self._state.phase.state == "calibrating":  # a stop may have come meanwhile: it takes no result back
            self._state.change(self._state.phase.calibrated())
        return result

    def _open(self, calibration_id: str = "", today: bool = False) -> Calibration:
        """The open calibration between two trains; `today`: if its day is not over."""
        calibration, phase = self._state.calibration, self._state.phase
        if calibration is None:
            raise PlanError("calibration: none is open (a stop or a fault closes it); start a new one")
        open_id = calibration.request.calibration_id
        if calibration_id not in ("", open_id):
            raise PlanError(f"calibration: {calibration_id!r} is not open; {open_id} is")
        if phase.state != "calibrating":
            raise BusyError(f"calibration: train {phase.test_id} is {phase.state}; wait or stop it")
        if today:
            calibration.check_day(self._tasks.clock.unix_s())
        return calibration
