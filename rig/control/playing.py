"""Plays one test, or one train of a calibration: from the first block of its journal to its sealed recording."""

from __future__ import annotations

import logging
import re
import threading

from rig import limits, plan
from rig.acquire.halt import Halt
from rig.acquire.run import RunResult, TestRun
from rig.control.core import Core
from rig.errors import JournalError, PlanError
from rig.trial import Trial

log = logging.getLogger("rig")

_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")


class Playing(Core):
    """Plays planned and admitted tests."""

    def _launch(self, test: plan.PlannedTest, table: dict[str, limits.Limit], following: Trial) -> None:
        """Create latch file, journal and thread, for every test and every train of a calibration."""
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
        gate, receiver, angle = self._pair.gate, self._pair.receiver, self._pair.angle
        assert gate is not None
        assert receiver is not None
        journal = self._store.begin(test, self._pair.identity, self._of_angle())
        halt = Halt(self._clock)
        run = TestRun(test, table, journal, gate, receiver, self._clock, halt, self._watch, angle)
        halt.on_set(lambda: self._halted(halt.reason))
        self._halt, self._run, self._evidence = halt, run, None
        self._evidence_ready.clear()
        self._next_live_pulse = 0
        self._thread = threading.Thread(target=self._execute, args=(run,), name="test", daemon=True)

    def _execute(self, run: TestRun) -> None:
        threading.Thread(target=self._announce, args=(run,), name="announce", daemon=True).start()
        try:
            result = run.execute()
            self._evidence = result.evidence
            self._evidence_ready.set()  # a stop's evidence does not wait for the disk
            self._remember_pulse(result)
            with self._lock:
                self._change(self._trial.ended())
            finished = self._store.finish(run.journal_path, run.plan.test_id, result)
        except Exception as error:  # a bug in this program: stay stopped, keep the journal for the next start
            log.exception("the test could not be ended properly")
            self._broken(f"internal: {type(error).__name__}: {error}")
            return
        with self._lock:
            self._run = None
            train = self._trial.calibrating
            if train and self._calibration is not None:
                self._calibration.played(run.plan.profile.max_pulse_width_us, result.rise_nm, finished)
            if not train:
                self.finished = finished
            if finished.recording_path is None and run.t0_s is not None:  # only a journal: needs a person
                self._change(self._trial.halted(finished.reason))
            following = self._trial.sealed()
            if following.state == "latched":
                self._remember("latched", following.reason)
            else:
                self._latch.clear()
            self._change(following)
        if not train:
            self._publish(finished)

    def _remember_pulse(self, result: RunResult) -> None:
        """Store the last pulse's time before another test may start; an unconfirmed end counts as a pulse now."""
        if result.last_pulse_s is not None:
            confirmed = result.evidence.confirmed
            self._rest.pulse_at(result.last_pulse_s if confirmed else self._clock.now_s(), ended=confirmed)

    def _broken(self, reason: str) -> None:
        self._evidence_ready.set()
        with self._lock:
            self._run = None
            self._remember("running", reason)
            self._change(Trial("latched", reason, lost=reason))
        self._rest.pulse_at(self._clock.now_s(), ended=False)

    def _announce(self, run: TestRun) -> None:
        """Tell that the test runs, from outside the thread that must be on time."""
        while not run.started.wait(0.05):
            if run.stimulation_ended.is_set():
                return
        with self._lock:
            if self._trial.state == "arming":
                self._change(self._trial.armed())


def check_names(place: str, **names: str) -> None:
    """Check names that become part of paths. Raises PlanError."""
    for name, value in names.items():
        if not _NAME.match(value):
            raise PlanError(f"{place}.{name}: {value!r} use letters, digits, '.', '_' and '-', at most 100 characters")
