"""Plays one test, or one train of a calibration: from the first block of its journal to its sealed recording.

An adaptive test is extended meanwhile, and ended well; `stimrig.rig.score` decides what is laid.
"""

from __future__ import annotations

import contextlib
import hmac
import logging
import math
import re

from stimrig.rig import limits, plan
from stimrig.rig.acquire.halt import Halt
from stimrig.rig.acquire.run import RunResult, TestRun
from stimrig.rig.control.core import Core
from stimrig.rig.errors import DeviceError, PlanError, RigError, TooLateError
from stimrig.rig.messages import (
    EnoughRequest,
    Extended,
    ExtendRequest,
    FinishedEvent,
    StopEvidence,
    Withdrawn,
    WithdrawRequest,
)
from stimrig.rig.trial import Trial

log = logging.getLogger("rig")

LONGEST_WORDS = 300
"""Characters of the reason of a stop or a withdrawal that are kept: a longer one counts, too."""
MOST_WITHDRAWN = 1000
"""Tests whose withdrawal is remembered."""
_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")


class Playing(Core):
    """Plays planned and admitted tests. What is asked while one plays waits for no start and no re-arm."""

    _key = ""

    async def _launch(self, test: plan.PlannedTest, table: dict[str, limits.Limit], following: Trial) -> None:
        """Create latch file and journal, then play: for every test and every train of a calibration.

        From here on a stop ends this test, also while its files are being made. Raises RigError: it does not begin.
        """
        before, halt = self._trial, Halt(self._clock)
        halt.on_set(lambda: self._ending(halt))
        self._halt, self._evidence = halt, None
        self._evidence_ready.clear()
        self._change(following)
        try:
            await self._latch.write("running", f"test {following.test_id} of participant {following.participant}")
            journal = await self._tasks.work(self._store.begin, test, self._pair.identity, self._of_angle())
            gate, receiver, angle = self._pair.gate, self._pair.receiver, self._pair.angle
            if gate is None or receiver is None:
                raise DeviceError("the devices were disconnected before the test began")
        except Exception:
            await self._not_begun(before)
            raise
        self._run = TestRun(test, table, journal, gate, receiver, self._machine, halt, self._watch, angle)
        self._run.on_evidence = self._take_evidence
        self._playing = self._tasks.spawn(self._execute(self._run), "test")

    def _ending(self, halt: Halt) -> None:
        if halt.cause == "withdrawn":
            self._change(self._trial.withdrawn())
        else:
            self._halted(halt.reason)

    async def withdraw(self, request: WithdrawRequest) -> Withdrawn:
        """See `WithdrawRequest`. Like a stop it waits for no turn, and for nothing else. Raises PlanError (its id)."""
        test_id, reason = request.test_id, f"withdrawn: {request.reason:.{LONGEST_WORDS}}"
        check_names("withdraw", test_id=test_id)
        present, run = self._trial.test_id == test_id, self._run
        ending = present and self._trial.state not in ("arming", "running")
        begun = present and run is not None and run.begun
        over = self.finished is not None and self.finished.test_id == test_id
        if ending or over or (begun and not request.begun):
            return Withdrawn(withdrawn=False)
        self._withdrawn[test_id] = reason
        if len(self._withdrawn) > MOST_WITHDRAWN:
            del self._withdrawn[next(iter(self._withdrawn))]
        if present and self._halt is not None:
            self._halt.set("withdrawn", reason)
        return Withdrawn(withdrawn=True)

    async def _not_begun(self, before: Trial) -> None:
        """No pulse was sent. A stop that came meanwhile counts as one of an idle rig."""
        halted = self._trial
        self._change(before)
        if halted.lost:
            self._change(before.disconnected(halted.lost))
        if halted.latch:
            self._halted(halted.reason)
        else:
            with contextlib.suppress(RigError):
                await self._latch.clear()
        self._evidence_ready.set()

    def _take_evidence(self, evidence: StopEvidence) -> None:
        self._evidence = evidence
        self._evidence_ready.set()

    async def _execute(self, run: TestRun) -> None:
        self._tasks.spawn(self._announce(run), "announce")
        try:
            result = await run.execute()
            if result.last_pulse_s is not None:  # stored before another test may start; an unconfirmed end is one now
                confirmed = result.evidence.confirmed
                await self._rest.pulse_at(result.last_pulse_s if confirmed else self._clock.now_s(), ended=confirmed)
            self._change(self._trial.ended())
            finished = await self._tasks.work(self._store.finish, run.journal.path, run.plan.test_id, result)
            await self._finish(run, result, finished)
        except Exception as error:  # a bug in this program: stay stopped, keep the journal for the next start
            log.exception("the test could not be ended properly")
            await self._broken(f"internal: {type(error).__name__}: {error}")

    async def _finish(self, run: TestRun, result: RunResult, finished: FinishedEvent) -> None:
        train = self._trial.calibrating
        if finished.recording_path is None and run.t0_s is not None:  # only a journal: needs a person
            self._change(self._trial.halted(finished.reason))
        await self._settle_latch()
        self._run = None
        if train and self._calibration is not None:
            self._calibration.played(run.plan.profile.max_pulse_width_us, result.rise_nm, finished)
        if not train:
            self.finished = finished
        self._change(self._trial.sealed())
        if not train:
            self._publish(finished)

    async def _settle_latch(self) -> None:
        """Store what the rig will be after this test; once more if it is stopped meanwhile."""
        stored = None
        while stored is not self._trial:
            stored = self._trial
            following = stored.sealed()
            if following.state == "latched":
                await self._remember(following)
            else:
                await self._latch.clear()

    async def _broken(self, reason: str) -> None:
        self._evidence_ready.set()
        self._run = None
        self._change(Trial("latched", reason, lost=reason))
        await self._remember(Trial("uncertain", reason))
        await self._rest.pulse_at(self._clock.now_s(), ended=False)

    async def _announce(self, run: TestRun) -> None:
        await self._tasks.wait(math.inf, run.started, run.halt.signal)
        if run.started.is_set() and self._trial.state == "arming":
            self._change(self._trial.armed())

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


def check_names(place: str, **names: str) -> None:
    """Check names that become part of paths. Raises PlanError."""
    for name, value in names.items():
        if not _NAME.match(value):
            raise PlanError(f"{place}.{name}: {value!r} use letters, digits, '.', '_' and '-', at most 100 characters")
