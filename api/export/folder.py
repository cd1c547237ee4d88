"""`stimrig export`: write each selected record as one file into a new folder, and list them in `records.csv`.

The files hold no dates; `records.csv` does, unless they are asked to be left out.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.progress import records_bar
from stimrig.api.cohort.record import read_selected
from stimrig.api.cohort.select import LABELS, Selection
from stimrig.api.cohort.sources import EXPORT_TABLES, SourceError, count_records, list_records, read_content
from stimrig.api.export.record_file import check_format, write_record
from stimrig.api.whole_file import whole_path
from stimrig.identify.errors import IdentifyError
from stimrig.identify.records.cells import lines
from stimrig.identify.records.columns import parse_column_map
from stimrig.identify.records.record import Record, Source

RECORDS, ERRORS = EXPORT_TABLES
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

    Parameters
    ----------
    data : sequence of str
        Files, folders, addresses.
    folder : Path
        New, or empty.
    format : str
        A key of `WRITERS`.
    select : str
        Which of them.
    columns : sequence of str
        Columns of other tools' tables, as --map gives them.
    dates : bool
        Whether `records.csv` has the columns of `DATED`.

    Raises
    ------
    BadRequest
        There is no such format or column, or pyarrow is missing.
    CohortError
        An address is missing, or the folder is not empty or cannot be written.
    """
    check_format(format)
    parse_column_map(columns)
    selection, total = Selection(select), count_records(data)
    rows: dict[str, dict[str, Any]] = {}  # by the SHA-256 of the record's file
    errors: list[tuple[str, str]] = []
    counts = Counter(left_out=0, copies=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise CohortError(f"{folder}: is not empty. Give a new folder.")
        with tempfile.TemporaryDirectory(prefix="stimrig-export-") as scratch, records_bar(total) as bar:
            for entry in list_records(data):
                path, row = Path(scratch) / f"record{Path(entry.name).suffix.lower()[:8]}", dict(entry.known)
                try:
                    if selection(row) is False:
                        counts["left_out"] += 1
                        continue
                    path.write_bytes(content := read_content(entry))
                    sha256 = hashlib.sha256(content).hexdigest()
                    if sha256 in rows:
                        counts["copies"] += 1
                        continue
                    record = read_selected(path, row, selection, columns)
                    if record is None:
                        counts["left_out"] += 1
                        continue
                    file = f"{_code(row)}_{sha256[:16]}.{format}"
                    with whole_path(folder / file) as place:
                        write_record(_undated(record), place, format)
                    rate_hz, notes = float(record.pulse_rate_hz), "; ".join(record.notes)
                    rows[sha256] = row | {"file": file, "sha256": sha256, "pulse_rate_hz": rate_hz, "notes": notes}
                except (IdentifyError, SourceError) as error:
                    errors.append((entry.address, str(error).replace(str(path), entry.name)))
                except MemoryError:
                    errors.append((entry.address, "it takes more memory than there is"))
                except OSError:
                    raise
                except Exception as error:  # a record of somebody else's: whatever it does, the others go on
                    errors.append((entry.address, f"unexpected: {type(error).__name__}: {error}"))
                finally:
                    path.unlink(missing_ok=True)
                    bar.update()
        header = (*UNDATED, *DATED) if dates else UNDATED
        _write_table(folder / RECORDS, header, ([row.get(column) for column in header] for row in rows.values()))
        _write_table(folder / ERRORS, ("address", "reason"), ((place, " ".join(why.split())) for place, why in errors))
    except OSError as error:
        raise CohortError(f"{folder}: {error.strerror or error}. Give a new folder with room.") from error
    return {
        "output": str(folder), "format": format, "records": len(rows), "errors": len(errors), **counts,
        "errors_file": str(folder / ERRORS),
    }  # fmt: skip


def _write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with whole_path(path) as place, place.open("w", encoding="utf-8", errors="replace") as file:
        file.writelines(lines([header, *rows]))


def _code(row: dict[str, Any]) -> str:
    """Return the participant's code as a part of a file's name."""
    return (
        "".join(letter for letter in row.get("participant") or "" if letter.isascii() and letter.isalnum()) or "unknown"
    )


def _undated(record: Record) -> Record:
    """Return a record without its file's name and the times of day at which its parts began."""
    return replace(record, source=Source(), parts=tuple(replace(part, begun_s=None) for part in record.parts))
