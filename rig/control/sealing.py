"""Creates the journal of a test, seals it into a recording, and recovers journals after a crash."""

from __future__ import annotations

import contextlib
import logging
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import archive, assembly, journal
from stimrig.rig.acquire.health import SYNC_PERIOD_S
from stimrig.rig.acquire.receiver import TorqueTime
from stimrig.rig.acquire.run import RunResult
from stimrig.rig.assembly import Recording
from stimrig.rig.config import RigConfig
from stimrig.rig.control.live import finite
from stimrig.rig.errors import BusyError, JournalError, PlanError, RecordingError
from stimrig.rig.journal import Journal, JournalContents, Kind
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.machine import Log, Machine
from stimrig.rig.messages import FinishedEvent
from stimrig.rig.plan import PlannedTest
from stimrig.rig.signals import MAY_BE_FELT, PulseStatus

REST_S = 0.1
"""Before the first pulse: what torque is rest."""
DOUBTFUL_ALIGNMENT_MS = 5.0
DOUBTFUL_RATE = 0.02
"""Beyond these a recording's times are uncertain, and its finished event says so. A larger rate error is a fault."""
CLIMB_S = 0.5
"""After a pause: so long the width may climb back."""
READ_S = 0.03
"""Before a pause, and while it ends: a period, and what is read at once."""
ROUNDED_US = 1.0
"""A width that is lower than planned by more was not only rounded to the device's step."""


def recovered_dose(recording: Recording, contents: JournalContents, lost_s: float) -> dict[str, Any]:
    """The dose of a test whose process died, from its journal's own lines: never less than what was felt.

    Part of a finished test's summary.

    `lost_s`: rig seconds before the test's end of which nothing may stand in the journal, as the computer lost its
    power: what was planned for so long counts, too.
    """
    columns, rate_hz = recording.columns, recording.attributes["pulse_rate_hz"]
    status, n = columns["pulses/status"], len(columns["pulses/status"])
    may_be_felt = np.isin(status, MAY_BE_FELT)
    widths_us, currents_ma = (columns[f"pulses/{name}"][may_be_felt] for name in ("sent_pulse_width_us", "current_ma"))
    widest_us = _largest(columns["pulses/pulse_width_us"], widths_us, HARD_LIMITS["pulse_width_us"].hi)
    highest_ma = _largest(np.array([recording.attributes["current_ma"]]), currents_ma, HARD_LIMITS["current_ma"].hi)
    widths_us = np.where(widths_us > 0, widths_us, widest_us)  # of a pulse whose width is lost
    currents_ma = np.where(currents_ma > 0, currents_ma, highest_ma)
    header = contents.first_json(Kind.HEADER)  # None: it is lost
    planned_us = np.empty(0) if header is None else assembly.planned_pulses(contents, header, [])[0]
    unseen_us = planned_us[n : n + int(np.ceil(lost_s * rate_hz))]
    doubtful = int(np.sum(status == PulseStatus.UNACKNOWLEDGED)) + int(np.sum(unseen_us > 0))
    played_s = max([n / rate_hz if may_be_felt.any() else 0.0, *columns["segments/end_s"].tolist()])
    return {
        "duration_s": played_s + len(unseen_us) / rate_hz,
        "pulses": int(may_be_felt.sum()) + int(np.sum(unseen_us > 0)),
        "dropped_pulses": int(np.sum(status == PulseStatus.DROPPED)),
        "charge_uc": float(np.sum(widths_us * currents_ma) + np.sum(unseen_us) * highest_ma) * 1e-3,
        **_torque_dose(
            columns["torque/time_s"], columns["torque/torque_nm"], columns["pulses/planned_time_s"][may_be_felt]
        ),
        "dose_is_bound": doubtful > 0,
        "doubtful_pulses": doubtful,
    }


def _largest(first: NDArray[Any], second: NDArray[Any], unknown: float) -> float:
    """The largest number of both; `unknown` where there is none above 0."""
    return max((float(value) for value in (*first, *second) if value > 0), default=unknown)


def _torque_dose(time_s: NDArray[Any], torque_nm: NDArray[Any], pulses_s: NDArray[Any]) -> dict[str, float]:
    """Torque-time since the first pulse, and the peak."""
    known = np.isfinite(torque_nm)
    time_s, torque_nm = time_s[known], torque_nm[known]
    peak_nm = float(np.abs(torque_nm).max()) if len(torque_nm) else 0.0
    if not len(pulses_s):
        return {"torque_time_nms": 0.0, "torque_peak_nm": peak_nm}
    first_s = float(pulses_s[0])
    resting = torque_nm[(time_s > first_s - REST_S) & (time_s <= first_s)]
    summed = TorqueTime()
    summed.begin(float(np.median(resting)) if len(resting) else 0.0, first_s)
    for at_s, value_nm in zip(time_s[time_s > first_s], torque_nm[time_s > first_s], strict=True):
        summed.add(float(at_s), float(value_nm))
    return {"torque_time_nms": summed.nms, "torque_peak_nm": peak_nm}


def summary_of(recording: Recording, counted: dict[str, Any]) -> dict[str, Any]:
    """Part of a finished test's summary; `counted`: what is known without the recording."""
    alignment, texts = recording.alignment, warnings(recording)
    if counted.get("dose_is_bound"):
        texts.append(
            _words(
                counted["doubtful_pulses"],
                "dose: of 1 pulse it is not known whether it was felt; it is counted, so the true dose may be lower",
                "dose: of {} pulses it is not known whether they were felt; they are counted, so the true dose may be "
                "lower",
            )
        )
    return {
        **({"angle": counted.get("angle", {}) | _angle_summary(recording)} if recording.angle else {}),
        "samples": len(recording.columns["torque/time_s"]),
        "sample_rate_hz": recording.attributes["sample_rate_measured_hz"],
        "alignment": {**asdict(alignment), "error_ms": finite(alignment.error_ms)},
        "warnings": texts,
        "notes": notes(recording),
    }


def _angle_summary(recording: Recording) -> dict[str, Any]:
    angle_rad, error_ms = recording.columns["angle/angle_rad"], recording.angle["error_ms"]
    return {
        "samples": len(angle_rad),
        "range_rad": [float(angle_rad.min()), float(angle_rad.max())] if len(angle_rad) else None,
        "method": recording.angle["method"],
        "error_ms": finite(error_ms),
    }


def _words(count: int, one: str, many: str) -> str:
    return one if count == 1 else many.format(count)


def _misaligned(error_ms: float) -> str:
    """The error of an alignment in words; empty where it is small."""
    if error_ms <= DOUBTFUL_ALIGNMENT_MS:
        return ""
    return "the error of their alignment is " + (f"{error_ms:.1f} ms" if finite(error_ms) else "unknown")


def warnings(recording: Recording) -> list[str]:
    """Warnings before a model is fitted to it, one sentence each; empty if there are none."""
    columns, attributes = recording.columns, recording.attributes
    texts = [
        *_line_warnings(recording),
        *(
            f"{event['reason']}; the angle in this recording may be wrong or missing"
            for event in _events(recording, "angle_trouble")
        ),
    ]
    if recording.angle and len(columns["angle/time_s"]) and (error := _misaligned(recording.angle["error_ms"])):
        texts.append(f"angle and torque: {error}; a model of a movement may be wrong")
    if attributes["journal_note"]:
        texts.append(f"journal: {attributes['journal_note']}")
    torque_nm = columns["torque/torque_nm"]
    if not len(torque_nm):
        return texts
    if np.all(torque_nm == torque_nm[0]):
        texts.append(
            f"load cell: its value stayed at exactly {torque_nm[0]:.3f} N·m in the whole test; it may be stuck"
        )
    if error := _misaligned(recording.alignment.error_ms):
        texts.append(
            f"torque and pulses: {error} (usual: up to {DOUBTFUL_ALIGNMENT_MS:g} ms), because the computer or the bus "
            "was blocked; delays in a model of this recording may be wrong"
        )
    nominal_hz, measured_hz = attributes["sample_rate_hz"], attributes["sample_rate_measured_hz"]
    if nominal_hz > 0 and not (abs(measured_hz / nominal_hz - 1) <= DOUBTFUL_RATE):
        texts.append(
            f"load cell: {measured_hz:.0f} samples/s arrived, the rig file says {nominal_hz:g}: times in this "
            "recording may be wrong"
        )
    return texts


def _events(recording: Recording, name: str) -> list[dict[str, Any]]:
    return [event for event in recording.events if event.get("event") == name]


def notes(recording: Recording) -> list[str]:
    """Return notes that put nothing in doubt: pauses of the computer, with their length and, if known, their cause."""
    pauses = _events(recording, "pause")
    if not pauses:
        return []
    count, whole_s = len(pauses), sum(pause["for_s"] for pause in pauses)
    text = f"the computer stopped for {whole_s:.1f} s; no current flowed meanwhile, and the test went on"
    if count > 1:
        text = f"the computer stopped {count} times, {whole_s:.1f} s in all; no current flowed, and the test went on"
    return [text, *sorted({pause["cause"] for pause in pauses} - {""})]


def _line_warnings(recording: Recording) -> list[str]:
    """Warnings about acknowledgements that came late or of what was not sent, dropped pulses and what followed.

    An acknowledgement that was read after a pause says nothing of the line.
    """
    columns, pauses, texts = recording.columns, _events(recording, "pause"), list[str]()
    if unasked := len(_events(recording, "unasked_ack")):
        texts.append(
            _words(
                unasked,
                "stimulator: it acknowledged 1 pulse that was not sent; it may have been felt and is not in this "
                "recording",
                "stimulator: it acknowledged {} pulses that were not sent; they may have been felt and are not in this "
                "recording",
            )
        )
    late_ms = [
        1e3 * event["delay_s"]
        for event in _events(recording, "late_ack")
        if not any(pause["time_s"] - pause["for_s"] - READ_S <= event["time_s"] <= pause["time_s"] for pause in pauses)
    ]
    if late_ms:
        late = _words(
            len(late_ms),
            "1 acknowledgement came late, {:.0f} ms after the pulse was sent; this pulse",
            "{} acknowledgements came late, up to {{:.0f}} ms after the pulse was sent; these pulses",
        ).format(max(late_ms))
        dropped = int(np.count_nonzero(columns["pulses/status"] == PulseStatus.DROPPED))
        lost = _words(dropped, "1 pulse of the test was dropped", "{} pulses of the test were dropped")
        texts.append(f"stimulator: {late} may have been felt that late; {lost}")
    planned_s, planned_us, sent_us = (
        columns[f"pulses/{name}"] for name in ("planned_time_s", "pulse_width_us", "sent_pulse_width_us")
    )
    narrower = (planned_us - sent_us > ROUNDED_US) & (sent_us > 0)  # one below the shortest pulse is not sent at all
    for pause in pauses:  # which tells why those that follow soon are narrow
        narrower &= (planned_s < pause["at_s"]) | (planned_s > pause["at_s"] + pause["for_s"] + CLIMB_S)
    if weaker := int(np.count_nonzero(narrower)):
        texts.append(
            f"stimulator: {_words(weaker, '1 pulse was', '{} pulses were')} narrower than planned, since after a pulse "
            "that was dropped, or too short to be sent, the width climbs no faster than its limit"
        )
    return texts


log = logging.getLogger("rig.sealing")

MIN_FREE_BYTES = 64 * 2**20
"""A test of the longest duration makes 25 MB of journal and as much of recording at 1600 samples/s."""


class RecordingStore:
    """The folders of unfinished journals and sealed recordings in the data folder. All of it may block for long."""

    def __init__(self, config: RigConfig, machine: Machine) -> None:
        self._config = config
        self._machine, self._disk, self._clock = machine, machine.disk, machine.tasks.clock
        self.journals = config.data_dir / "journals"
        self.recordings = config.data_dir / "recordings"

    def make_folders(self) -> None:
        for folder in (self.journals, self.recordings):
            self._disk.make_folder(folder)

    def check_room(self, test_id: str) -> None:
        """Check that a test of that id can be stored.

        Raises PlanError: the id was already used. JournalError: the disk is nearly full.
        """
        sealed = any(name.endswith(f"Z_{test_id}.h5") for name in self._disk.names(self.recordings))
        if sealed or f"{test_id}.journal" in self._disk.names(self.journals):
            raise PlanError(f"plan.test_id: {test_id!r} was already used; give each test a new id")
        free = self._free_bytes()
        if free < MIN_FREE_BYTES:
            raise JournalError(
                f"data_dir {self._config.data_dir}: {free // 2**20} MB free; a test needs {MIN_FREE_BYTES // 2**20}; "
                "move old recordings away"
            )

    def _free_bytes(self) -> int:
        try:
            return self._disk.free_bytes(self._config.data_dir)
        except OSError as error:
            raise JournalError(f"data_dir {self._config.data_dir}: {error.strerror}; check the disk") from None

    def begin(self, test: PlannedTest, identity: dict[str, Any], angle: dict[str, Any] | None = None) -> Journal:
        """Create a journal with its header and plan, synced to the disk. Raises JournalError.

        Of an adaptive test only the first segment is certain. `angle` describes the angle sensor, if there is one.
        """
        certain = test.segments if test.plan.adaptive is None else test.segments[:1]
        book = Journal(self._create(self.journals / f"{test.plan.test_id}.journal"))
        header = {
            "recording_id": self._machine.new_id(),
            "boot_id": self._machine.boot_id,
            "plan": test.plan.model_dump(mode="json"),
            "segments": [segment._asdict() for segment in certain],
            "current_ma": test.plan.profile.current_ma,
            "sample_rate_hz": self._config.load_cell.model_dump().get("sample_rate_hz", 0.0),
            "software": software(),
            "configuration": {**self._config.public(), "devices": identity},
            "time_s": self._clock.now_s(),
            "unix_s": self._clock.unix_s(),
            **({} if angle is None else {"angle": angle}),
        }
        try:
            book.begin(header, test.pulse_width_us[: certain[-1].end].astype("<f8").tobytes())
        except JournalError:
            book.close()
            with contextlib.suppress(OSError):  # or the next start would take it for a test that died
                self._disk.remove(book.path)
            raise
        return book

    def _create(self, path: Path) -> Log:
        try:
            return self._disk.create(path)
        except OSError as error:
            raise JournalError(f"journal {path}: {error.strerror}; free some disk space or correct data_dir") from None

    def finish(self, path: Path, test_id: str, result: RunResult) -> FinishedEvent:
        return self._seal(path, test_id, result.outcome, result.reason, result.summary, result.last_sample_unix_s)

    def recover(self, reason: str) -> list[FinishedEvent]:
        """Seal the journals that a crash or a full disk left; a journal with nothing to seal is renamed, never deleted.

        `reason`: why it was left; used for journals that do not say how the test ended.
        Raises BusyError: another rig writes one; `rig.lock` may have been removed. Then none is touched.
        """
        names = [name for name in self._disk.names(self.journals) if name.endswith(".journal")]
        for path in (self.journals / name for name in names):
            if self._disk.is_written(path):
                raise BusyError(f"journal {path}: another rig writes it; stop that rig first")
        events = []
        for name in names:
            path = self.journals / name
            log.warning("recovering %s", name)
            events.append(self._seal(path, path.stem, "fault", reason, {"recovered": True}, None))
            remains = name in self._disk.names(self.journals)
            if remains and self._free_bytes() >= MIN_FREE_BYTES:  # else the disk is full: try again later
                with contextlib.suppress(OSError):
                    self._disk.rename(path, path.with_suffix(".unsealed"))
        return events

    def _unseen_s(self, contents: journal.JournalContents) -> float:
        """Rig seconds before its end of which a journal may know nothing: what is not synced goes with the power."""
        header = contents.first_json(journal.Kind.HEADER) or {}
        if contents.ended or header.get("boot_id", "") in ("", self._machine.boot_id):
            return 0.0
        return (self._config.watch.stale_disk_s + SYNC_PERIOD_S) * self._clock.speed

    def _seal(
        self, path: Path, test_id: str, outcome: str, reason: str, summary: dict[str, Any], unix_s: float | None
    ) -> FinishedEvent:
        """Seal a journal and remove it; if that fails, the journal stays and the event says why.

        Of a damaged journal the readable part is sealed, and the file is kept as `TEST_ID.damaged`.
        """
        sealed = None
        try:
            contents = journal.parse(path, self._disk.read(path))
            recording = assembly.assemble(contents, outcome, reason)
            if summary.get("recovered"):
                summary |= recovered_dose(recording, contents, self._unseen_s(contents))
            sealed = archive.seal(recording, self.recordings, self._disk)
            if contents.damaged:  # the readable part is sealed; the file is kept for inspection
                self._disk.rename(path, path.with_suffix(".damaged"))
            else:
                self._disk.remove(path)
        except (RecordingError, OSError) as error:
            log.error("%s", error, extra={"test_id": test_id})
            reason = "; ".join(part for part in (reason, str(error)) if part)
        event: dict[str, Any] = {"outcome": outcome, "reason": reason, "summary": summary}
        if sealed is not None:
            event = {name: sealed.recording.attributes[name] for name in ("outcome", "reason", "recording_id")}
            event |= {"recording_path": str(sealed.path), "file_sha256": sealed.file_sha256}
            event["summary"] = summary | summary_of(sealed.recording, summary)
        event |= {"test_id": test_id, "last_sample_unix_s": unix_s}
        return FinishedEvent.model_validate(event)


def software() -> str:
    try:
        return f"stimrig {version('stimrig')}"
    except PackageNotFoundError:
        return "stimrig (not installed)"
