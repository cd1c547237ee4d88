"""Requests during an adaptive test: more segments, and enough of them. `rig.score` decides what is laid."""

from __future__ import annotations

import hmac
import logging

from rig.acquire.run import TestRun
from rig.control.calibrating import Calibrating
from rig.errors import PlanError, TooLateError
from rig.messages import EnoughRequest, Extended, ExtendRequest, TestPlan

log = logging.getLogger("rig")

MIN_KEY = 16


class Extending(Calibrating):
    """Extends the running test and ends it well. Waits for no start and no re-arm."""

    _key = ""

    async def extend(self, request: ExtendRequest) -> Extended:
        """Lay segments behind everything that is laid.

        Raises
        ------
        TooLateError
            That test is over or ending, or more was laid since the client decided.
        PlanError, RefusedError
            The test is not adaptive, its key is another, a segment is wrong or outside a limit.
        BusyError
            Too many at once.
        JournalError
            It could not be written.
        """
        run = self._running(request.test_id)
        if not hmac.compare_digest(request.key.encode("utf-8", "replace"), self._key.encode("utf-8", "replace")):
            raise PlanError("extend.key: it is not the key with which this test was started")
        await run.score.extend(request.after, request.segments)
        names = ", ".join(segment.name for segment in request.segments)
        log.info("extended by %s, %.3f s are laid", names, run.score.duration_s, extra={"test_id": request.test_id})
        return run.score.left(run.torque_time_nms)

    async def enough(self, request: EnoughRequest) -> Extended:
        """End the running test with its safe end. Raises TooLateError, PlanError, JournalError."""
        run = self._running(request.test_id)
        run.score.enough(request.by, request.at_once)
        log.info("enough, by %s", request.by or "a client", extra={"test_id": request.test_id})
        return run.score.left(run.torque_time_nms)

    def _running(self, test_id: str) -> TestRun:
        """The adaptive test of that id, if it is the one that plays."""
        run = self._run
        if run is None or run.plan.test_id != test_id:
            raise TooLateError(f"test {test_id!r} is not running")
        if run.plan.adaptive is None:
            raise PlanError(f"test {test_id} has a fixed plan; it can only be stopped")
        return run


def check_key(request: TestPlan, key: str) -> None:
    """An adaptive test needs a key, so that only who started it extends it. Raises PlanError."""
    if request.adaptive is not None and len(key) < MIN_KEY:
        raise PlanError(f"start.key: an adaptive test needs one of at least {MIN_KEY} characters; make a random one")
