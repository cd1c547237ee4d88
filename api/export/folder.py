"""`stimrig export`: write each selected record as one file into a new folder, and list them in `records.csv`.

The files hold no dates; `records.csv` does, unless they are asked to be left out.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.record import LEFT_OUT, Row, failed, read_row
from stimrig.api.cohort.select import LABELS, Selection
from stimrig.api.cohort.sources import EXPORT_TABLES, Entry, SourceError, count_records, list_records, read_content
from stimrig.api.export.record_file import check_format, write_record
from stimrig.api.progress_bar import records_bar
from stimrig.api.whole_file import whole_path
from stimrig.identify.records.cells import lines
from stimrig.identify.records.columns import parse_column_map
from stimrig.identify.records.record import Record, Source

RECORDS, ERRORS = EXPORT_TABLES
COPY = "copy"
"""Status of a record whose content was exported already."""
UNDATED = ("file", "participant", "record_id", "sha256", "pulse_rate_hz", "rate_hz", "duration_s", "outcome")
DATED = ("begun_utc", "test_id", "name", *LABELS, "notes")
"""Columns of `records.csv`: those that tell no day, and those that do, or that a person typed."""


def export_records(
    data: Sequence[str],
    folder: Path,
    format: str = "csv",
    select: str = "",
    columns: Sequence[str] = (),
    *,
    dates: bool = True,
) -> dict[str, Any]:
    """Write records into a folder; return the keys of `stimrig export --json`.

    `data`: files, folders, addresses; `folder`: new, or empty; `format`: a key of `WRITERS`; `select`: which of them;
    `columns`: of other tools' tables, as --map gives them; `dates`: whether `records.csv` has the columns of `DATED`.

    Raises BadRequest: there is no such format or column, or pyarrow is missing. CohortError: an address is missing, or
    the folder is not empty or cannot be written.
    """
    check_format(format)
    parse_column_map(columns)
    selection, total = Selection(select), count_records(data)
    rows: dict[str, Row] = {}  # by the SHA-256 of the record's file
    errors: list[tuple[str, str]] = []
    counts = Counter(left_out=0, copies=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise CohortError(f"{folder}: is not empty. Give a new folder.")
        with tempfile.TemporaryDirectory(prefix="stimrig-export-") as scratch, records_bar(total) as bar:
            for entry in list_records(data):
                row: Row = {"status": LEFT_OUT}
                if selection(entry.known) is not False:
                    row = _exported(entry, Path(scratch), folder, format, selection, columns, rows)
                if row["status"] == "ok":
                    rows[row["sha256"]] = row
                elif row["status"] == "error":
                    errors.append((entry.address, row["error"]))
                else:
                    counts["copies" if row["status"] == COPY else "left_out"] += 1
                bar.update()
        header = (*UNDATED, *DATED) if dates else UNDATED
        _write_table(folder / RECORDS, header, ([row.get(column) for column in header] for row in rows.values()))
        _write_table(folder / ERRORS, ("address", "reason"), errors)
    except OSError as error:
        raise CohortError(f"{folder}: {error.strerror or error}. Give a new folder with room.") from error
    return {
        "output": str(folder), "format": format, "records": len(rows), "errors": len(errors), **counts,
        "errors_file": str(folder / ERRORS),
    }  # fmt: skip


def _exported(
    entry: Entry, scratch: Path, folder: Path, format: str, selection: Selection, columns: Sequence[str],
    done: Container[str],
) -> Row:  # fmt: skip
    """Write one record, unless its content is `done` already; return its row. Raises OSError: there is no room."""
    try:
        content = read_content(entry)
    except SourceError as error:
        return failed(error.kind, str(error))
    if (sha256 := hashlib.sha256(content).hexdigest()) in done:
        return {"status": COPY}

    def write(record: Record) -> Row:
        code = "".join(letter for letter in record.source.participant if letter.isascii() and letter.isalnum())
        file = f"{code or 'unknown'}_{sha256[:16]}.{format}"
        with whole_path(folder / file) as place:
            write_record(_undated(record), place, format)
        notes, rate_hz = "; ".join(record.notes), float(record.pulse_rate_hz)
        return {"file": file, "sha256": sha256, "pulse_rate_hz": rate_hz, "notes": notes}

    path = scratch / f"record{Path(entry.name).suffix.lower()[:8]}"
    path.write_bytes(content)
    return read_row(path, entry.name, entry.known, selection, columns, write)


def _write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with whole_path(path) as place, place.open("w", encoding="utf-8", errors="replace") as file:
        file.writelines(lines([header, *rows]))


def _undated(record: Record) -> Record:
    """Return a record without its file's name and the times of day at which its parts began."""
    return replace(record, source=Source(), parts=tuple(replace(part, begun_s=None) for part in record.parts))
