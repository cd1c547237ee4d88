"""An export: each selected record read, written in a format, and noted as done; what cannot be is told."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import date, datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import IO, Any, Protocol

from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.record import describe
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, Source, SourceError
from stimrig.api.cohort.tally import Tally, Tell, counting
from stimrig.api.cohort.tasks import CutOffError
from stimrig.api.cohort.whole_record import WholeRecord, read_whole
from stimrig.api.whole_file import whole_file
from stimrig.identify.errors import IdentifyError
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES
from stimrig.identify.records.cells import lines
from stimrig.rig.messages import LABEL_TITLES

UNDATED = "undated"
ERRORS = "errors.csv"


class NoExport(Exception):
    """A record that cannot be exported: kind and reason, for its line of `errors.csv`."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind, self.reason = kind, reason


@dataclass(frozen=True)
class Days:
    """What becomes of dates: kept, moved by some days, or left out."""

    hide: bool = False
    shift_days: int = 0

    @property
    def kept(self) -> bool:
        """Whether they are as they were."""
        return not self.hide and not self.shift_days

    def begun(self, utc: str | None) -> str | None:
        """A time (ISO 8601) as it may be told."""
        if self.hide or not utc:
            return None
        try:
            return (datetime.fromisoformat(utc) + timedelta(days=self.shift_days)).isoformat()
        except (ValueError, OverflowError):
            return None

    def session(self, day: str | None, participant: str, salt: str) -> str:
        """Label of a session: its day in digits, or what stands for it."""
        if not day:
            return UNDATED
        if self.hide:
            return "s" + hmac.new(salt.encode(), f"{participant}\0{day}".encode(), hashlib.sha256).hexdigest()[:10]
        return (date.fromisoformat(day) + timedelta(days=self.shift_days)).strftime("%Y%m%d")


@dataclass(frozen=True)
class Who:
    """Whose record it is, and how it is called."""

    participant: str
    label: str
    session: str
    record_id: str
    key: str  # letters and digits that no other record has: it names files
    begun_utc: str | None


Put = Callable[[str], Any]
"""Gives a file to write at a place, which takes it as a whole or not at all."""


class Writer(Protocol):
    """A format: a module."""

    NAME: str

    def write(self, record: WholeRecord, who: Who, put: Put, /) -> dict[str, Any]:
        """Write a record's files; its row for `finish`. Raises NoExport."""
        ...

    def finish(self, state: State, put: Put, /) -> None: ...


def hidden(record: WholeRecord, days: Days) -> WholeRecord:
    """The record without what would tell the days that are not to be told."""
    if days.kept:
        return record
    told = {"address", "name", "origin", "reason", "configuration", "events", "laid", "day", "begun_utc", "test_id"}
    told |= LABEL_TITLES.keys()  # a person typed them
    return replace(record, about={key: value for key, value in record.about.items() if key not in told}, notes=())


UNKNOWN = "unknown"


@dataclass
class Export:
    """One export."""

    sources: Sequence[Source]  # where the records are
    selection: Selection  # which are meant
    state: State  # of the folder
    writer: Writer  # the format
    days: Days  # what becomes of dates
    columns: Sequence[str] = ()  # `--map` for tables of other tools
    tell: Tell = lambda _: None  # called with the tally after every record
    tally: Tally = field(default_factory=Tally)

    def __post_init__(self) -> None:
        self._salt = self.state.option("salt", secrets.token_hex(16))
        self._places: list[str] = []

    def go(self) -> Tally:
        """Export all, and what is made of all.

        Raises CohortError: a source is not there. CutOffError: the disk is full, or the like; the same command goes on.
        """
        for source in self.sources:
            source.check()
        with tempfile.TemporaryDirectory(prefix="stimrig-export-") as folder, self._on_the_disk():
            with counting(self.tally, self.sources, self.selection):
                for source in self.sources:
                    for entry in source.entries():
                        self._one(source, entry, Path(folder))
                        self.tell(self.tally)
            self.writer.finish(self.state, self.put)
            with self.put(ERRORS) as file:
                rows = chain([("address", "kind", "reason")], self.state.failures())
                file.writelines(line.encode("utf-8", "replace") for line in lines(rows))
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
        said = dict(entry.known)
        describe(path, said)
        if self.selection(said) is False:
            self.tally.left_out += 1
            return
        record = read_whole(content, path, said, self.columns)
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
        self.tally.ok += 1

    def _who(self, record: WholeRecord) -> Who:
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
        self.tally.error += 1
        self.state.failed(entry.address, kind, reason)

    @contextmanager
    def put(self, place: str) -> Iterator[IO[bytes]]:
        """A file in the export: written aside, and renamed when it is whole."""
        target = self.state.folder / place
        with whole_file(target, self.state.place / f"{secrets.token_hex(4)}.part") as file:
            yield file
            target.parent.mkdir(parents=True, exist_ok=True)
        self._places.append(place)

    @contextmanager
    def _on_the_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise CutOffError(
                f"{self.state.folder}: {error.strerror or error}; what is done is kept, and the same command goes on "
                "with it."
            ) from None
