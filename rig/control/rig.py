"""The rig: both devices, one test at a time, and what is told about it. Knows no socket."""

from __future__ import annotations

import logging
import re
import threading
import uuid
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rig import archive, devices, journal, limits, plan
from rig.acquire.halt import Halt
from rig.acquire.receiver import Receiver
from rig.acquire.run import FRESH_S, RunResult, TestRun, lateness_ms
from rig.clock import Clock
from rig.config import RigConfig
from rig.control.latch import Latch, lock_folder
from rig.control.live import live_event
from rig.errors import DeviceError, PlanError, RecordingError
from rig.gate import Gate
from rig.journal import Journal, Kind
from rig.messages import (
    Event,
    FinishedEvent,
    LiveEvent,
    Preview,
    PreviewRequest,
    StateEvent,
    Status,
    StopEvidence,
    TestPlan,
)
from rig.trial import Trial

log = logging.getLogger("rig")

_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")
STOP_TIMEOUT_S = 6.0
"""Real seconds to wait for the evidence of a stop, decay of the torque included."""


class Rig:
    """Owns the devices. Every method may be called from any thread.

    Parameters
    ----------
    publish
        Takes every event but the live ones; called from any thread, must not block.
    """

    def __init__(self, config: RigConfig, clock: Clock, publish: Callable[[Event], None]) -> None:
        self._config = config
        self._clock = clock
        self._publish = publish
        self._table = config.limits.table()
        for folder in (config.data_dir, self.journals, self.recordings):
            folder.mkdir(parents=True, exist_ok=True)
        self._folder_lock = lock_folder(config.data_dir)
        self._latch = Latch(config.data_dir)
        self._lock = threading.RLock()
        self._trial = Trial()
        self._gate: Gate | None = None
        self._receiver: Receiver | None = None
        self._identity: dict[str, dict[str, Any]] = {"stimulator": {}, "load_cell": {}}
        self._halt: Halt | None = None
        self._run: TestRun | None = None
        self._thread: threading.Thread | None = None
        self._evidence: StopEvidence | None = None
        self._told = threading.Event()
        self._next_live_pulse = 0
        self._born_s = clock.now_s()
        self.finished: FinishedEvent | None = None

    @property
    def journals(self) -> Path:
        """Where unfinished journals lie."""
        return self._config.data_dir / "journals"

    @property
    def recordings(self) -> Path:
        """Where sealed recordings lie."""
        return self._config.data_dir / "recordings"

    def open(self) -> None:
        """Recover what a crash left, then connect; a device that is not there is told, not raised."""
        remembered, reason = self._latch.read()
        recovered = self._recover()
        if remembered == "running" or recovered:
            before, reason = "uncertain", f"the rig died during a test ({reason or 'a journal was left'})"
        else:
            before = "latched" if remembered == "latched" else None
        try:
            self._connect()
        except DeviceError as error:
            if before is not None:  # the latch outlives the missing device
                self._change(Trial().connected(before, reason).disconnected(str(error)))
            else:
                self._change(Trial("disconnected", str(error)))
            log.error("%s", error)
            return
        self._change(Trial().connected(before, reason))

    def close(self) -> None:
        """Stop what runs, wait until it is sealed, disconnect."""
        self.stop("the rig is shutting down", "rig", latch_idle=False)
        thread = self._thread
        if thread is not None:
            thread.join(timeout=30)
        self._disconnect()
        self._folder_lock.close()

    def status(self) -> Status:
        """How things stand now."""
        with self._lock:
            trial, run, receiver = self._trial, self._run, self._receiver
        elapsed_s = run.elapsed_s() if run else 0.0
        age_s = receiver.age_s(self._clock.now_s()) if receiver and receiver.last_s is not None else None
        cell = dict(self._identity["load_cell"])
        if receiver and (measured_hz := receiver.measured_rate_hz()) is not None:
            cell["measured_rate_hz"] = round(measured_hz, 2)
        return Status(
            state=trial.state,
            reason=trial.reason + (f"; {trial.lost}" if trial.lost else ""),
            test_id=trial.test_id,
            participant=trial.participant,
            segment=run.test.segment_at(elapsed_s) if run and run.t0_s is not None else None,
            elapsed_s=elapsed_s,
            duration_s=run.test.duration_s if run else 0.0,
            stimulator=self._identity["stimulator"],
            load_cell=cell,
            torque_age_s=age_s,
            torque_nm=_finite(receiver.last_torque_nm) if receiver else None,
            finished=self.finished,
        )

    def preview(self, request: PreviewRequest) -> Preview:
        """Duration, dose and pulses of a plan. Raises PlanError, RefusedError."""
        table = limits.for_profile(self._table, request.plan.profile)
        return plan.preview(plan.build(request.plan, table), request.recruitment)

    def live(self) -> LiveEvent | None:
        """The newest torque and pulses; None where nothing came since the last call."""
        with self._lock:
            run, receiver, now_s = self._run, self._receiver, self._clock.now_s()
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
            for name, value in (("test_id", request.test_id), ("participant", request.participant)):
                if not _NAME.match(value):
                    raise PlanError(f"plan.{name}: {value!r} must be letters, digits, '.', '_' or '-', at most 100")
            table = limits.for_profile(self._table, request.profile)
            test = plan.build(request, table)
            assert self._gate is not None and self._receiver is not None
            file = self.journals / f"{request.test_id}.journal"
            if file.exists() or any(self.recordings.glob(f"*Z_{request.test_id}.h5")):
                raise PlanError(f"plan.test_id: {request.test_id!r} was used before; give each test a new id")
            self._latch.write("running", f"test {request.test_id} of participant {request.participant}")
            book = self._journal(file, test)
            self._halt = Halt(self._clock)
            self._evidence = None
            self._told.clear()
            self._run = TestRun(
                test, table, book, self._gate, self._receiver, self._clock, self._halt, self._config.watch.watch()
            )
            self._next_live_pulse = 0
            self._halt.on_set(self._halting)
            self._change(self._trial.start(request.test_id, request.participant))
            self._thread = threading.Thread(target=self._execute, args=(self._run, book), name="test", daemon=True)
            self._thread.start()
        return self.status()

    def stop(self, reason: str, by: str, latch_idle: bool = True) -> StopEvidence:
        """Stop stimulation now, latch, and say what the device and the torque tell of it."""
        words = f"{reason} (by {by})" if by else reason
        with self._lock:
            busy, halt, gate = self._trial.busy, self._halt, self._gate
        if busy and halt is not None:
            halt.set("stopped", words)
            self._told.wait(STOP_TIMEOUT_S)
            return self._evidence or StopEvidence(
                confirmed=False, detail="no pulse leaves; the device did not answer in time"
            )
        if latch_idle:
            self._halted(words)
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
            if not self._both_answer():
                self._disconnect()
                self._connect()
                if not self._torque_comes():
                    raise DeviceError("load cell: connected, but no torque comes; check its cable and start frames")
            self._latch.clear()
            log.info("re-armed by %s after: %s", by, self._trial.reason)
            self._change(following)
        return self.status()

    def _both_answer(self) -> bool:
        """Stop the stimulator anew and ask its state; is torque coming?"""
        if self._gate is None or self._receiver is None or self._trial.lost:
            return False
        try:
            self._gate.stop()
            self._gate.state()
        except DeviceError:
            return False
        return self._torque_comes()

    def _torque_comes(self) -> bool:
        """Does a sample arrive from now on, within a short time?"""
        assert self._receiver is not None
        asked_s = self._clock.now_s()
        end_s = asked_s + FRESH_S * self._clock.speed
        while self._receiver.age_s(asked_s) >= 0:
            if self._clock.now_s() > end_s:
                return False
            self._clock.wait(self._clock.now_s() + 0.005 * self._clock.speed)
        return True

    def _connect(self) -> None:
        stimulator = devices.find("stimulator", self._config.stimulator.device).create(
            self._config.stimulator, self._clock
        )
        cell = devices.find("load_cell", self._config.load_cell.device).create(self._config.load_cell, self._clock)
        gate = Gate(stimulator, self._clock, self._fault)
        self._identity["stimulator"] = gate.identify()
        try:
            self._identity["load_cell"] = cell.open()
        except DeviceError:
            gate.disconnect()
            raise
        with self._lock:
            self._gate = gate
            self._receiver = Receiver(cell, self._clock, self._fault)
            self._receiver.start()

    def _disconnect(self) -> None:
        if self._gate is not None:
            self._gate.disconnect()
        if self._receiver is not None:
            self._receiver.close()
        self._gate = self._receiver = None

    def _fault(self, reason: str) -> None:
        """A device says that something is wrong, from one of its threads."""
        halt = self._halt
        if halt is not None and self._trial.busy:
            halt.set("fault", reason)
        with self._lock:
            self._change(self._trial.disconnected(reason))
        log.error("%s", reason)

    def _halting(self) -> None:
        assert self._halt is not None
        self._halted(self._halt.reason)

    def _halted(self, reason: str) -> None:
        with self._lock:
            following = self._trial.halted(reason)
            if following.state == "latched":
                self._latch.write("latched", reason)
            self._change(following)

    def _change(self, trial: Trial) -> None:
        with self._lock:
            changed = trial != self._trial
            self._trial = trial
        if changed:
            log.info("state %s %s", trial.state, trial.reason, extra={"test_id": trial.test_id})
            self._publish(StateEvent(status=self.status()))

    def _journal(self, path: Path, test: plan.PlannedTest) -> Journal:
        book = Journal(path)
        book.append_json(
            Kind.HEADER,
            {
                "recording_id": uuid.uuid4().hex,
                "plan": test.plan.model_dump(mode="json"),
                "segments": [{"name": s.name, "start": s.start, "end": s.end} for s in test.segments],
                "current_ma": test.plan.profile.current_ma,
                "sample_rate_hz": self._config.load_cell.model_dump().get("sample_rate_hz", 0.0),
                "software": software(),
                "configuration": {**self._config.public(), "devices": self._identity},
                "time_s": self._clock.now_s(),
                "unix_s": self._clock.unix_s(),
            },
        )
        book.append(Kind.PLAN, test.pulse_width_us.astype("<f8").tobytes())
        book.sync()
        return book

    def _execute(self, run: TestRun, book: Journal) -> None:
        threading.Thread(target=self._announce, args=(run,), name="announce", daemon=True).start()
        result = run.execute()
        self._evidence = result.evidence
        self._told.set()
        self._change(self._trial.ended())
        finished = self._seal(run, book.path, result)
        with self._lock:
            self._run = None
            self.finished = finished
            following = self._trial.sealed()
            if following.state == "latched":
                self._latch.write("latched", following.reason)
            else:
                self._latch.clear()
            self._change(following)
        self._publish(finished)

    def _announce(self, run: TestRun) -> None:
        """Tell that the test runs, from outside the thread that must be on time."""
        while not run.started.wait(0.05):
            if run.stimulation_ended.is_set():
                return
        with self._lock:
            if self._trial.state == "arming":
                self._change(self._trial.armed())

    def _seal(self, run: TestRun, path: Path, result: RunResult) -> FinishedEvent:
        summary: dict[str, Any] = {
            "duration_s": result.duration_s,
            "samples": result.counts.samples,
            "lost_samples": result.counts.lost_samples,
            "duplicate_samples": result.counts.duplicate_samples,
            "disordered_samples": result.counts.disordered_samples,
            "malformed_frames": result.counts.malformed_frames,
            "error_frames": result.counts.error_frames,
            "pulses": len(result.lateness_s),
            "dropped_pulses": result.dropped,
            "lateness_ms": lateness_ms([s / self._clock.speed for s in result.lateness_s]),
            "charge_uc": result.charge_uc,
            "torque_peak_nm": result.peak_nm,
            "cpu_percent": round(result.cpu_percent, 2),
            "stop": result.evidence.model_dump(),
        }
        return self._finish(
            path, run.test.plan.test_id, result.outcome, result.reason, summary, result.last_sample_unix_s
        )

    def _finish(
        self, path: Path, test_id: str, outcome: str, reason: str, summary: dict[str, Any], unix_s: float | None
    ) -> FinishedEvent:
        """Seal a journal and remove it; where that fails the journal stays and the event says why."""
        sealed = None
        try:
            sealed = archive.seal(journal.read(path), self.recordings, outcome, reason)
            path.unlink()
        except RecordingError as error:
            log.error("%s", error, extra={"test_id": test_id})
            reason = "; ".join(part for part in (reason, str(error)) if part)
        if sealed is not None:
            attributes, alignment = sealed.recording.attributes, sealed.recording.alignment
            outcome, reason = attributes["outcome"], attributes["reason"]
            summary = {
                **summary,
                "samples": len(sealed.recording.columns["torque/time_s"]),
                "sample_rate_hz": attributes["sample_rate_measured_hz"],
                "alignment": {
                    "method": alignment.method,
                    "error_ms": _finite(alignment.error_ms),
                    "delay_ms": alignment.delay_ms,
                    "rate_ppm": alignment.rate_ppm,
                },
            }
        return FinishedEvent.model_validate(
            {
                "test_id": test_id,
                "outcome": outcome,
                "reason": reason,
                "recording_path": str(sealed.path) if sealed else None,
                "recording_id": sealed.recording.attributes["recording_id"] if sealed else None,
                "file_sha256": sealed.file_sha256 if sealed else None,
                "last_sample_unix_s": unix_s,
                "summary": summary,
            }
        )

    def _recover(self) -> bool:
        """Seal the journals that a crash left; True if there were any."""
        left = sorted(self.journals.glob("*.journal"))
        for path in left:
            log.warning("recovering %s", path.name)
            reason = "the rig process died during the test"
            self.finished = self._finish(path, path.stem, "fault", reason, {"recovered": True}, None)
            if path.exists():
                path.rename(path.with_suffix(".unsealed"))
            self._publish(self.finished)
        return bool(left)


def software() -> str:
    """Name and version, as recordings carry it."""
    try:
        return f"stimrig {version('stimrig')}"
    except PackageNotFoundError:
        return "stimrig (not installed)"


def _finite(value: float | None) -> float | None:
    return None if value is None or value != value or abs(value) == float("inf") else value
