"""Results on disk: a line for each row beside the output while the run goes on, one Parquet file in the end.

`RESULTS.parquet.rows` holds the options of the run and then its rows, as JSON. The next run with the same options skips
the records that have a row, there or in the output.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import date, datetime
from heapq import merge
from itertools import islice
from pathlib import Path
from typing import IO, Any, Self

import pyarrow.parquet as pq

from stimrig.api.cohort import table
from stimrig.api.cohort.errors import CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT, Row
from stimrig.api.cohort.sources import Entry
from stimrig.api.cohort.task import Task
from stimrig.api.whole_file import whole_path

TO_DISK_S = 10.0
"""Longest time of results that a run loses where the machine goes down, s."""
GROUP_ROWS = 5000
COPY = "copy"
"""Status of a row whose content has a newer row: of another address."""
TRANSIENT = ("timeout", "killed", "out of memory", "unreadable", "unexpected")
"""Errors that another try may not meet (`--again`)."""
TIMES = {"day": date, "begun_utc": datetime, "computed_utc": datetime}
"""Columns that are texts in JSON."""


class Results:
    """The results of one run, in a Parquet file `output`; a `with` statement holds their lock.

    `task`: with the options that all rows share; `again`: compute records with a transient error again.

    Raises CohortError: the place cannot be written, another run writes it, or it was made with other options.
    """

    def __init__(self, output: Path, task: Task, again: bool = False) -> None:
        self.output, self.task, self.again = output, task, again
        self.journal = output.with_name(output.name + ".rows")
        self._done: set[bytes] = set()  # files in the state in which they were done
        self._file: IO[bytes]
        self._synced_s = time.monotonic()

    def __enter__(self) -> Self:
        if self.output.exists() and not self.output.is_file():
            raise CohortError(f"{self.output}: a folder or a device. Give a file.")
        try:
            self._file = self.journal.open("a+b")
        except OSError as error:
            raise CohortError(
                f"{self.journal}: {error.strerror}. Give a file in a folder that can be written."
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not self.journal.exists() or self.journal.stat().st_ino != os.fstat(self._file.fileno()).st_ino:
                raise BlockingIOError  # the run that had the lock has removed the file
            self._read()
        except BlockingIOError:
            self._file.close()
            words = "another run writes it now. Wait for it, or give another -o."
            raise CohortError(f"{self.output}: {words}") from None
        except BaseException:
            if not self.journal.stat().st_size:  # it was made here
                self.journal.unlink()
            self._file.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self.journal.stat().st_size <= len(self._header()):  # nothing to resume from
            self.journal.unlink()
        self._file.close()

    def _header(self) -> bytes:
        return json.dumps(self.task.options()).encode() + b"\n"

    def _read(self) -> None:
        """Compare the options, and read which records are done; remove a line that was cut off."""
        if self.output.exists():
            self._compare(table.read_options(self.output), self.output)
        self._file.seek(0)
        if not (header := self._file.readline()):
            self._write(self._header())
        else:
            self._compare(_parse(header, self.journal), self.journal)
            self._file.truncate(len(header) + sum(len(line) for line in self._file if line.endswith(b"\n")))
        for row in self._rows(("address", "stamp", "error_kind")):
            if row["stamp"] and not (self.again and row.get("error_kind") in TRANSIENT):
                self._done.add(_digest(row["address"], row["stamp"]))

    def _compare(self, before: Mapping[str, Any], file: Path) -> None:
        now = self.task.options()
        if other := [name for name in now if before.get(name) != now[name]]:
            words = ", ".join(f"{name} {before.get(name, 'none')}, now {now[name]}" for name in other)
            raise CohortError(f"{file}: made with other options ({words}). Give another -o, or remove it.")

    def _rows(self, columns: tuple[str, ...] = ()) -> Iterator[Row]:
        """Yield all rows, the oldest first; of those in the output these columns, or all."""
        if self.output.exists():
            yield from table.read_rows(self.output, columns)
        with self.journal.open("rb") as file:
            yield from (self._row(line) for line in islice(file, 1, None))

    def _row(self, line: bytes) -> Row:
        row = _parse(line, self.journal)
        return row | {name: kind.fromisoformat(row[name]) for name, kind in TIMES.items() if row.get(name)}

    def has(self, entry: Entry) -> bool:
        """Return whether this file, in its state of now, has a row."""
        return bool(entry.stamp) and _digest(entry.address, entry.stamp) in self._done

    def add(self, row: Row) -> str:
        """Write a record's row, unless it was not selected; return its status. Raises InterruptedRunError."""
        if row["status"] != LEFT_OUT:
            self._write(json.dumps(row, default=str).encode() + b"\n")
        return row["status"]

    def _write(self, line: bytes) -> None:
        try:
            self._file.write(line)
            self._file.flush()
            if time.monotonic() - self._synced_s > TO_DISK_S:
                self._synced_s = time.monotonic()
                os.fsync(self._file.fileno())
        except OSError as error:
            raise _no_room(self.journal, error) from None

    def join(self) -> Counter[str]:
        """Write the output in the order of addresses, empty what stands beside it, and count the rows by status.

        Raises InterruptedRunError: the disk refuses; the lines stay.
        """
        statuses = self._statuses()
        schema = table.SCHEMA.with_metadata({"format": table.FORMAT, "options": json.dumps(self.task.options())})
        try:
            with whole_path(self.output) as place, pq.ParquetWriter(place, schema, compression="zstd") as writer:
                rows = ({**row, "status": status} for row, status in self._sorted(statuses) if status)
                while some := list(islice(rows, GROUP_ROWS)):
                    writer.write_table(table.rows_to_table(some))
        except OSError as error:
            raise _no_room(self.output, error) from None
        self._file.truncate(0)
        return Counter(status for status in statuses if status)

    def _sorted(self, statuses: Sequence[str | None]) -> Iterator[tuple[Row, str | None]]:
        """Yield the rows in the order of addresses: those of the output are, each line is read where it stands."""
        old = table.read_rows(self.output) if self.output.exists() else ()
        with self.journal.open("rb") as file:
            places, place = list[tuple[str, int]](), len(file.readline())
            for line in file:
                places.append((_parse(line, self.journal)["address"], place))
                place += len(line)
            count = len(statuses) - len(places)

            def line_at(place: int) -> Row:
                file.seek(place)
                return self._row(file.readline())

            order = sorted(zip(places, statuses[count:], strict=True), key=lambda pair: pair[0])
            new = ((line_at(place), status) for (_address, place), status in order)
            yield from merge(zip(old, statuses[:count], strict=True), new, key=lambda pair: pair[0]["address"])

    def _statuses(self) -> list[str | None]:
        """Return the status of each row, the oldest first; None: its file has a newer row."""
        statuses: list[str | None] = []
        places, contents = set[bytes](), set[Any]()
        columns = ("address", "sha256", "status")
        keys = [(_digest(row["address"]), row.get("sha256"), row["status"]) for row in self._rows(columns)]
        for place, sha256, status in reversed(keys):
            if place in places:
                statuses.append(None)
            elif status == "error":
                statuses.append(status)
            else:
                statuses.append(COPY if sha256 in contents else "ok")
                contents.add(sha256)
            places.add(place)
        return statuses[::-1]


def _digest(*texts: str) -> bytes:
    """Return sixteen bytes that stand for texts: a run remembers every record."""
    return hashlib.blake2b("\0".join(texts).encode(), digest_size=16).digest()


def _parse(line: bytes, file: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(line))
    except (ValueError, TypeError):
        raise CohortError(f"{file}: a line of it is damaged. Remove it, or give another -o.") from None


def _no_room(file: Path, error: OSError) -> InterruptedRunError:
    return InterruptedRunError(f"{file}: {error.strerror}. Make room; the same command goes on.")
