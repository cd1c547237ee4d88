"""Recordings read as one record: several files of one muscle are the parts of it.

Imported by the worker and the command line only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.identify.records.join import join
from stimrig.identify.records.recording import attributes

JOINT = ("angle_rad", "velocity_rad_s")


def read(
    paths: Sequence[Path],
    columns: Sequence[str] | None = None,
    needs: Sequence[str] = (),
    name: Callable[[int], str] | None = None,
    note: Callable[[str], None] | None = None,
) -> Any:
    """A record of one file, or of several joined.

    Parameters
    ----------
    paths : sequence of Path
        At least one; where all begins are known they are put in the order of time.
    needs : sequence of str
        Columns that each of them must have.
    name : callable, optional
        How a file is called in an error, by its number from 0; default: its path.
    note : callable, optional
        Gets what was assumed, a line each.

    Raises
    ------
    BadRecord
        A file cannot be read or lacks a column, or they do not go together: names the file.
    """
    called = name or (lambda number: str(paths[number]))
    records = [identify.read(path, map=columns) for path in paths]
    say = note or (lambda _words: None)
    for number, record in enumerate(records):
        for words in record.notes:
            say(f"{called(number)}: {words}")
    check_columns(records, needs, called)
    if len(records) == 1:
        return records[0]
    for words in _dropped(records, called):
        say(words)
    try:
        return join(records, [begun(path) for path in paths])
    except identify.BadRecord as error:
        raise _by_name(error, len(records), called) from error


def _by_name(error: Any, count: int, called: Callable[[int], str]) -> Any:
    """The same error, the file called by its name and not by its number."""
    numbers = {f"recording {number + 1}": number for number in range(count)}
    if error.place not in numbers:
        return error
    return identify.BadRecord(error.message, place=called(numbers[error.place]), fix=error.fix)


def check_columns(records: Sequence[Any], needs: Sequence[str], called: Callable[[int], str]) -> None:
    """Refuse a record that lacks a column which the model needs. Raises BadRecord, which names the record."""
    for number, record in enumerate(records):
        lacking = [column for column in needs if getattr(record, column) is None]
        if lacking:
            raise identify.BadRecord(
                f"it has no {', '.join(lacking)}, which an effect of the model needs",
                place=called(number),
                fix="Leave it out, or record it anew on a rig with an angle sensor.",
            )


def _dropped(records: Sequence[Any], called: Callable[[int], str]) -> list[str]:
    """What is left out of the whole since some of the parts lack it."""
    found = []
    for column in JOINT:
        lacking = [called(number) for number, record in enumerate(records) if getattr(record, column) is None]
        if 0 < len(lacking) < len(records):
            found.append(f"{', '.join(lacking)}: no {column}, so it is left out of the joined record")
    return found


def begun(path: Path) -> float | None:
    """When a sealed recording's clock was 0, as Unix time; None for CSV: a joined one says it of its parts."""
    try:
        return datetime.fromisoformat(attributes(path, ["created_utc"])["created_utc"]).timestamp()
    except (identify.IdentifyError, ValueError, OverflowError):
        return None
