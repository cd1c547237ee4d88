"""Creates the journal of a test, seals it into a recording, and recovers journals after a crash."""

from __future__ import annotations

import contextlib
import logging
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from stimrig.rig import archive, assembly, journal
from stimrig.rig.acquire.health import SYNC_PERIOD_S
from stimrig.rig.acquire.run import RunResult
from stimrig.rig.config import RigConfig
from stimrig.rig.control.summary import recovered_dose, summary_of
from stimrig.rig.errors import JournalError, PlanError, RecordingError
from stimrig.rig.journal import Journal
from stimrig.rig.machine import Log, Machine
from stimrig.rig.messages import FinishedEvent
from stimrig.rig.plan import PlannedTest

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

        Raises
        ------
        PlanError
            The id was already used.
        JournalError
            The disk is nearly full.
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
            "segments": [{"name": s.name, "start": s.start, "end": s.end, "by": "plan"} for s in certain],
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

        Parameters
        ----------
        reason
            Why it was left; used for journals that do not say how the test ended.
        """
        events = []
        for name in self._disk.names(self.journals):
            path = self.journals / name
            if path.suffix != ".journal":
                continue
            log.warning("recovering %s", name)
            events.append(self._seal(path, path.stem, "fault", reason, {"recovered": True}, None))
            left = name in self._disk.names(self.journals)
            if left and self._free_bytes() >= MIN_FREE_BYTES:  # else the disk is full: try again later
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
