"""`stimrig export`: write each selected record as one file into a new folder, and list them in `records.csv`.

The files hold no dates; `records.csv` does, unless they are asked to be left out.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stimrig.api.cohort.record import describe, read
from stimrig.api.cohort.select import LABELS, Selection
from stimrig.api.cohort.sources import EXPORT_TABLES, Entry, Source, SourceError
from stimrig.api.cohort.tally import Tally, Tell, counting
from stimrig.api.cohort.tasks import CohortError
from stimrig.api.export.record_file import write_record
from stimrig.api.whole_file import whole_path
from stimrig.identify.errors import IdentifyError
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES
from stimrig.identify.records.cells import lines
from stimrig.identify.records.record import Record
from stimrig.identify.records.record import Source as RecordSource

RECORDS, ERRORS = EXPORT_TABLES
UNDATED = ("file", "participant", "record_id", "sha256", "pulse_rate_hz", "rate_hz", "duration_s", "outcome")
DATED = ("begun_utc", "test_id", "name", *LABELS, "notes")
"""Columns of `records.csv`: those that tell no day, and those that do, or that a person typed."""


@dataclass
class Export:
    """One export of records into a folder."""

    sources: Sequence[Source]
    selection: Selection
    folder: Path  # new, or empty
    format: str  # a key of `WRITERS`
    map: Sequence[str] = ()  # columns of other tools' tables
    dates: bool = True  # whether `records.csv` has the columns of `DATED`
    tell: Tell = lambda _: None  # called with the tally after every record
    tally: Tally = field(default_factory=Tally)

    def __post_init__(self) -> None:
        self._rows: dict[str, dict[str, Any]] = {}  # by the SHA-256 of the record's file
        self._errors: list[tuple[str, str]] = []

    def run(self) -> Tally:
        """Write all. Raises CohortError: a source is not there, or the folder is not empty or cannot be written."""
        for source in self.sources:
            source.check()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.iterdir()):
                raise CohortError(f"{self.folder}: is not empty. Give a new folder.")
            with (
                tempfile.TemporaryDirectory(prefix="stimrig-export-") as aside,
                counting(self.tally, self.sources, self.selection),
            ):
                for source in self.sources:
                    for entry in source.entries():
                        self._export(source, entry, Path(aside))
                        self.tell(self.tally)
            columns = (*UNDATED, *DATED) if self.dates else UNDATED
            rows = ([row.get(column) for column in columns] for row in self._rows.values())
            self._write_table(RECORDS, columns, rows)
            self._write_table(ERRORS, ("address", "reason"), self._errors)
        except OSError as error:
            raise CohortError(f"{self.folder}: {error.strerror or error}. Give a new folder with room.") from error
        return self.tally

    def _write_table(self, name: str, header: Sequence[str], rows: Any) -> None:
        with whole_path(self.folder / name) as place, place.open("w", encoding="utf-8", errors="replace") as file:
            file.writelines(lines([header, *rows]))

    def _export(self, source: Source, entry: Entry, aside: Path) -> None:
        """Write one record, or note why it cannot be."""
        if self.selection(entry.known) is False:
            self.tally.left_out += 1
            return
        path = aside / f"record{Path(entry.name).suffix.lower()[:8]}"
        try:
            content = source.open(entry, LARGEST_FILE_BYTES)
            path.write_bytes(content)
            self._write(path, hashlib.sha256(content).hexdigest(), dict(entry.known))
        except (IdentifyError, SourceError) as error:
            self._fail(entry, str(error).replace(str(path), entry.name))
        except MemoryError:
            self._fail(entry, "it takes more memory than there is")
        except OSError:
            raise
        except Exception as error:  # a record of somebody else's: whatever it does, the others go on
            self._fail(entry, f"unexpected: {type(error).__name__}: {error}")
        finally:
            path.unlink(missing_ok=True)

    def _write(self, path: Path, sha256: str, row: dict[str, Any]) -> None:
        if sha256 in self._rows:
            self.tally.copies += 1
            return
        sealed = describe(path, row)
        record = None if self.selection(row) is False else read(path, () if sealed else self.map, row)
        if record is None or self.selection(row) is False:
            self.tally.left_out += 1
            return
        label = "".join(letter for letter in row.get("participant") or "" if letter.isascii() and letter.isalnum())
        file = f"{label or 'unknown'}_{sha256[:16]}.{self.format}"
        with whole_path(self.folder / file) as place:
            write_record(undated(record), place, self.format)
        row |= {"pulse_rate_hz": float(record.pulse_rate_hz), "notes": "; ".join(record.notes)}
        self._rows[sha256] = {**row, "file": file, "sha256": sha256}
        self.tally.ok += 1

    def _fail(self, entry: Entry, reason: str) -> None:
        self.tally.error += 1
        self._errors.append((entry.address, " ".join(reason.split())))


def undated(record: Record) -> Record:
    """Return the record without its file's name and without the times of day at which its parts began."""
    return replace(record, source=RecordSource(), parts=tuple(replace(part, begun_s=None) for part in record.parts))
