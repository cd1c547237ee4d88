"""Plays one test, or one train of a calibration: from the first block of its journal to its sealed recording.

An adaptive test is extended meanwhile, and ended well; `rig.score` decides what is laid.
"""

from __future__ import annotations

import contextlib
import hmac
import logging
import math
import re
from collections.abc import Callable

from stimrig.rig import limits, plan
from stimrig.rig.acquire.health import Watch
from stimrig.rig.acquire.run import Cause, Halt, RunResult, TestRun
from stimrig.rig.control.angle_calibration import Joint
from stimrig.rig.control.memory import Rest
from stimrig.rig.control.pair import Pair
from stimrig.rig.control.sealing import RecordingStore
from stimrig.rig.control.state import State
from stimrig.rig.errors import DeviceError, PlanError, RigError, TooLateError, WithdrawnError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import Event, Extended, FinishedEvent, Withdrawn
from stimrig.rig.phase import Phase
from stimrig.rig.requests import EnoughRequest, ExtendRequest, WithdrawRequest
from stimrig.rig.tasks import Task

log = logging.getLogger("rig")

LONGEST_WORDS = 300
"""Characters of the reason of a stop or a withdrawal that are kept: a longer one counts, too."""
MOST_WITHDRAWN = 1000
"""Tests whose withdrawal is remembered."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


class Player:
    """Plays planned and admitted tests, one at a time. What is asked meanwhile waits for no start and no re-arm."""

    def __init__(
        self, state: State, pair: Pair, joint: Joint, rest: Rest, store: RecordingStore, machine: Machine,
        watch: Watch, publish: Callable[[Event], None],
    ) -> None:  # fmt: skip
        self.state, self.pair, self.joint, self.rest, self.store = state, pair, joint, rest, store
        self._machine, self.tasks, self._clock, self._watch = machine, machine.tasks, machine.tasks.clock, watch
        self._publish = publish
        self.run: TestRun | None = None
        self.playing: Task[None] | None = None
        self.finished: FinishedEvent | None = None
        """The newest test that has finished, recovered ones included."""
        self.withdrawals: dict[str, str] = {}
        """Tests that must not begin any more, and why: the newest ones."""
        self._halt: Halt | None = None
        self._key = ""

    def refuse_withdrawn(self, test_id: str) -> None:
        """Raise WithdrawnError if that test was withdrawn meanwhile."""
        if (withdrawn := self.withdrawals.get(test_id)) is not None:
            raise WithdrawnError(f"test {test_id}: {withdrawn}; ask for a new test")

    async def launch(
        self, test: plan.PlannedTest, table: dict[str, limits.Limit], following: Phase, key: str = ""
    ) -> None:
        """Create latch file and journal, then play: for every test and every train of a calibration.

        From here on a stop ends this test, also while its files are being made. Raises RigError: it does not begin.

        `following`: the state from now on. `key`: what extensions of an adaptive test must know.
        """
        state, before, halt = self.state, self.state.phase, Halt(self._clock)
        halt.on_set(lambda: self._ending(halt))
        self._halt, self._key = halt, key
        state.change(following)
        try:
            await state.file.write("running", f"test {following.test_id} of participant {following.participant}")
            journal = await self.tasks.work(self.store.begin, test, self.pair.identity, self.joint.described())
            gate, receiver, sensor = self.pair.gate, self.pair.receiver, self.pair.angle
            if gate is None or receiver is None:
                raise DeviceError("the devices were disconnected before the test began")
        except Exception:
            await self._not_begun(before, halt)
            raise
        self.run = TestRun(test, table, journal, gate, receiver, self._machine, halt, self._watch, sensor)
        self.playing = self.tasks.spawn(self._execute(self.run), "test")

    def end(self, cause: Cause, reason: str, latch_idle: bool = True) -> Halt | None:
        """End the running test, or latch; None: no test runs."""
        self.state.count_stop()
        halt = self._halt if self.state.phase.busy else None
        ends_now = halt is not None and halt.set(cause, reason)
        if latch_idle and not ends_now:  # of a test that was ending both reasons are told
            self.state.halted(reason)
        return halt

    def trouble(self) -> str | None:
        """That the task of the test has died; None: it has not."""
        phase = self.state.phase
        if phase.busy and self.run is not None and (self.playing is None or self.playing.done.is_set()):
            return f"the task of test {phase.test_id} ended, but its test did not"
        return None

    async def withdraw(self, request: WithdrawRequest) -> Withdrawn:
        """See `WithdrawRequest`. Like a stop it waits for no turn, and for nothing else. Raises PlanError (its id)."""
        test_id, reason = request.test_id, f"withdrawn: {request.reason:.{LONGEST_WORDS}}"
        check_names("withdraw", test_id=test_id)
        present, run = self.state.phase.test_id == test_id, self.run
        ending = present and self.state.phase.state not in ("arming", "running")
        begun = present and run is not None and run.begun
        over = self.finished is not None and self.finished.test_id == test_id
        if ending or over or (begun and not request.begun):
            return Withdrawn(withdrawn=False)
        self.withdrawals[test_id] = reason
        if len(self.withdrawals) > MOST_WITHDRAWN:
            del self.withdrawals[next(iter(self.withdrawals))]
        if present and self._halt is not None:
            self._halt.set("withdrawn", reason)
        return Withdrawn(withdrawn=True)

    async def extend(self, request: ExtendRequest) -> Extended:
        """Lay segments behind everything that is laid.

        Raises TooLateError: that test is over or ending, or more was laid since the client decided. PlanError: it is
        not adaptive, or its key is another. Others as `Score.extend`.
        """
        run = self._running(request.test_id)
        if not hmac.compare_digest(request.key.encode("utf-8", "replace"), self._key.encode("utf-8", "replace")):
            raise PlanError("extend.key: it is not the key with which this test was started")
        await run.score.extend(request.after, request.segments)
        queued = len(request.segments), run.score.duration_s
        log.info("extended by %d segments, %.3f s are laid", *queued, extra={"test_id": request.test_id})
        return run.score.progress(run.torque_time_nms)

    async def enough(self, request: EnoughRequest) -> Extended:
        """End the running test with its safe end. Raises TooLateError, PlanError, JournalError."""
        run = self._running(request.test_id)
        run.score.enough(request.by, request.at_once)
        log.info("enough", extra={"test_id": request.test_id})
        return run.score.progress(run.torque_time_nms)

    def _running(self, test_id: str) -> TestRun:
        """The adaptive test of that id, if it is the one that plays."""
        run = self.run
        if run is None or run.plan.test_id != test_id:
            raise TooLateError(f"test {test_id!r} is not running")
        if run.plan.adaptive is None:
            raise PlanError(f"test {test_id} has a fixed plan; it can only be stopped")
        return run

    def _ending(self, halt: Halt) -> None:
        if halt.cause == "withdrawn":
            self.state.change(self.state.phase.withdrawn())
        else:
            self.state.halted(halt.reason)

    async def _not_begun(self, before: Phase, halt: Halt) -> None:
        """No pulse was sent. A stop that came meanwhile counts as one of an idle rig."""
        state, halted = self.state, self.state.phase
        idle = before.disconnected(halted.lost) if halted.lost else before
        if halted.latch:  # in one step: it must not be told as ready on the way
            state.halted(halted.reason, idle)
        else:
            state.change(idle)
            with contextlib.suppress(RigError):
                await state.file.clear()
        halt.settled.set()

    async def _execute(self, run: TestRun) -> None:
        self.tasks.spawn(self._announce(run), "announce")
        try:
            result = await run.execute()
            if result.last_pulse_s is not None:  # stored before another test may start; an unconfirmed end is one now
                confirmed = result.evidence.confirmed
                await self.rest.pulse_at(result.last_pulse_s if confirmed else self._clock.now_s(), ended=confirmed)
            self.state.change(self.state.phase.ended())
            finished = await self.tasks.work(self.store.finish, run.journal.path, run.plan.test_id, result)
            await self._finish(run, result, finished)
        except Exception as error:  # a bug in this program: stay stopped, keep the journal for the next start
            log.exception("the test could not be ended properly")
            run.halt.settled.set()
            await self._broken(f"internal: {type(error).__name__}: {error}")

    async def _announce(self, run: TestRun) -> None:
        await self.tasks.wait(math.inf, run.started, run.halt.signal)
        if run.started.is_set() and self.state.phase.state == "arming":
            self.state.change(self.state.phase.armed())

    async def _finish(self, run: TestRun, result: RunResult, finished: FinishedEvent) -> None:
        state, train = self.state, self.state.phase.calibrating
        if finished.recording_path is None and run.t0_s is not None:  # only a journal: needs a person
            state.change(state.phase.halted(finished.reason))
        await state.settle()
        self.run = None
        if train and state.calibration is not None:
            state.calibration.played(run.plan.profile.max_pulse_width_us, result.rise_nm, finished)
        if not train:
            self.finished = finished
        state.change(state.phase.sealed())
        if not train:
            self._publish(finished)

    async def _broken(self, reason: str) -> None:
        self.run = None
        self.state.change(Phase("latched", reason, lost=reason))
        await self.state.remember(Phase("uncertain", reason))
        await self.rest.pulse_at(self._clock.now_s(), ended=False)


def check_names(place: str, **names: str) -> None:
    """Check names that become part of paths. Raises PlanError."""
    for name, value in names.items():
        if not _NAME.fullmatch(value):
            raise PlanError(f"{place}.{name}: {value!r} use letters, digits, '.', '_' and '-', at most 100 characters")
