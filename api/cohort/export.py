"""An export: each selected record read, written by a writer, and noted as done; what cannot be is told."""

from __future__ import annotations

import hashlib
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO

from stimrig.api.cohort.errors import CutOffError
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.handed_on import ERRORS, Days, NoExport, Who, Writer, hidden
from stimrig.api.cohort.opened import Opened, opened, said_of
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, Source, SourceError
from stimrig.identify.errors import IdentifyError
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES
from stimrig.identify.records.cells import lines

UNKNOWN = "unknown"


@dataclass
class Tally:
    """How far an export is."""

    written: int = 0
    before: int = 0
    failed: int = 0
    left_out: int = 0
    copies: int = 0


@dataclass
class Export:
    """One export.

    Parameters
    ----------
    sources : sequence of Source
        Where the records are.
    selection : Selection
        Which are meant.
    state : State
        Of the folder.
    writer : Writer
        The format.
    days : Days
        What becomes of dates.
    columns : sequence of str
        `--map` for tables of other tools.
    tell : callable
        Called with the tally after every record.
    """

    sources: Sequence[Source]
    selection: Selection
    state: State
    writer: Writer
    days: Days
    columns: Sequence[str] = ()
    tell: Callable[[Tally], None] = lambda _: None
    tally: Tally = field(default_factory=Tally)

    def __post_init__(self) -> None:
        self._salt = self.state.option("salt", secrets.token_hex(16))
        self._places: list[str] = []

    def go(self) -> Tally:
        """Export all, and what is made of all.

        Raises
        ------
        CohortError
            A source is not there.
        CutOffError
            The disk is full, or the like; the same command goes on.
        """
        for source in self.sources:
            source.check()
        with tempfile.TemporaryDirectory(prefix="stimrig-export-") as folder, self._on_the_disk():
            for source in self.sources:
                for entry in source.entries(self.selection):
                    self._one(source, entry, Path(folder))
                    self.tell(self.tally)
            self.writer.finish(self.state, self.put)
            self._write_errors()
        return self.tally

    def _one(self, source: Source, entry: Entry, folder: Path) -> None:
        known = {**entry.known}
        if self.selection(known) is False:
            self.tally.left_out += 1
        elif self.state.is_done(entry.address, entry.stamp):
            self.tally.before += 1
        else:
            try:
                self._read(source, entry, folder)
            except SourceError as error:
                self._fail(entry, "unreadable", str(error))
            except NoExport as error:
                self._fail(entry, error.kind, error.reason)
            except MemoryError:
                self._fail(entry, "out of memory", "it takes more memory than there is")
            except OSError:
                raise
            except Exception as error:  # a record of somebody else's: whatever it does, the others go on
                self._fail(entry, "unexpected", f"{type(error).__name__}: {error}")

    def _read(self, source: Source, entry: Entry, folder: Path) -> None:
        content = source.open(entry, LARGEST_FILE_BYTES)
        if len(content) > LARGEST_FILE_BYTES:
            raise NoExport("bad record", f"more than {LARGEST_FILE_BYTES // 2**20} MB")
        sha256 = hashlib.sha256(content).hexdigest()
        if entry.sha256 and sha256 != entry.sha256:
            raise NoExport(
                "hash differs", f"its content differs from its hash: {sha256[:12]}…, not {entry.sha256[:12]}…"
            )
        if self.state.is_copy(entry.address, sha256):
            self.tally.copies += 1
            return
        path = folder / f"record{Path(entry.name).suffix.lower()[:8]}"
        path.write_bytes(content)
        try:
            self._write(entry, content, sha256, path)
        except IdentifyError as error:
            raise NoExport("bad record", str(error).replace(str(path), entry.name)) from error
        finally:
            path.unlink(missing_ok=True)

    def _write(self, entry: Entry, content: bytes, sha256: str, path: Path) -> None:
        if self.selection(said_of(content, path, entry.known)) is False:
            self.tally.left_out += 1
            return
        record = opened(content, path, entry.known, self.columns)
        if self.selection(record.about) is False:
            self.tally.left_out += 1
            return
        record.about["address"] = entry.address
        who = self._who(record)
        before = self.state.files(entry.address)
        self._places = []
        row = self.writer.write(hidden(record, self.days), who, self.put)
        row["files"] = self._places
        self.state.done(entry.address, entry.stamp, sha256, (who.participant, who.session), row)
        for place in set(before) - set(self._places):  # of the record as it was
            (self.state.folder / place).unlink(missing_ok=True)
        self.tally.written += 1

    def _who(self, record: Opened) -> Who:
        code = record.about.get("participant") or UNKNOWN
        try:
            label = self.state.label(code)
        except ValueError as error:
            raise NoExport("label", str(error)) from None
        session = self.days.session(record.about.get("day"), code, self._salt)
        begun = self.days.begun(record.about.get("begun_utc"))
        key = record.sha256[:16]
        return Who(code, label, session, record.about.get("record_id") or key, key, begun)

    def _fail(self, entry: Entry, kind: str, reason: str) -> None:
        self.tally.failed += 1
        self.state.failed(entry.address, kind, reason)

    @contextmanager
    def put(self, place: str) -> Iterator[IO[bytes]]:
        """A file in the export: written aside, and renamed when it is whole."""
        target = self.state.folder / place
        aside = self.state.place / f"{secrets.token_hex(4)}.part"
        try:
            with aside.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            target.parent.mkdir(parents=True, exist_ok=True)
            aside.replace(target)
            self._places.append(place)
        finally:
            aside.unlink(missing_ok=True)

    def _write_errors(self) -> None:
        with self.put(ERRORS) as file:
            rows = chain([("address", "kind", "reason")], self.state.failures())
            file.writelines(line.encode("utf-8", "replace") for line in lines(rows))

    @contextmanager
    def _on_the_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise CutOffError(
                f"{self.state.folder}: {error.strerror or error}; what is done is kept, and the same command goes on "
                "with it."
            ) from None
