"""Results on disk: parts beside the output while the run goes on, joined into one file in the end.

`RESULTS.parquet.parts/` holds a lock and parts, each written whole or not at all, with the options of the run. The next
run with the same options skips the records that have a row, in the output or in a part.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Self

import pyarrow as pa
import pyarrow.parquet as pq

from stimrig.api.cohort import table
from stimrig.api.cohort.errors import CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT, Row
from stimrig.api.cohort.sources import Entry
from stimrig.api.cohort.task import Task
from stimrig.api.whole_file import whole_path

PART_ROWS = 500
PART_S = 10.0
"""What a run that is killed loses at most."""
GROUP_ROWS = 5000
COPY = "copy"
"""Status of a row whose content has a newer row: of another address."""
TRANSIENT = ("timeout", "killed", "out of memory", "unreadable", "unexpected")
"""Errors that another try may not meet (`--again`)."""


class Results:
    """The results of one run; a `with` statement holds their lock.

    Parameters
    ----------
    output : Path
        The Parquet file to write.
    task : Task
        With the options that all rows share.
    again : bool
        Compute records with a transient error again.

    Raises
    ------
    CohortError
        The place cannot be written, another run writes it, or what is there was made with other options.
    """

    def __init__(self, output: Path, task: Task, again: bool = False) -> None:
        self.output, self.task, self.again = output, task, again
        self.folder = output.with_name(output.name + ".parts")
        self._done: set[bytes] = set()  # files in the state in which they were done
        self._waiting: list[Row] = []
        self._written_s = time.monotonic()
        self._lock: IO[bytes] | None = None

    def __enter__(self) -> Self:
        if self.output.is_dir():
            raise CohortError(f"{self.output}: a folder. Give a file.")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / "lock").open("ab")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._unlock()
            raise CohortError(f"{self.output}: another run writes it now. Wait for it, or give another -o.") from None
        except OSError as error:
            self._unlock()
            remedy = "Give a file in a folder that can be written."
            raise CohortError(f"{self.folder}: {error.strerror}. {remedy}") from None
        try:
            self._read()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
        finally:
            self._close()

    def _close(self) -> None:
        if not self._parts():  # nothing to resume from
            shutil.rmtree(self.folder, ignore_errors=True)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.parquet"))

    def _files(self) -> list[Path]:
        """List the files with rows, the oldest first."""
        return [*([self.output] if self.output.exists() else []), *self._parts()]

    def _read(self) -> None:
        """Compare the options, and read which records are done."""
        now = self.task.options()
        for file in self._files():
            before = table.read_options(file)
            if other := [name for name in now if before.get(name) != now[name]]:
                words = ", ".join(f"{name} {before.get(name, 'none')}, now {now[name]}" for name in other)
                raise CohortError(f"{file}: made with other options ({words}). Give another -o, or remove it.")
            for row in table.read_rows(file, ("address", "stamp", "error_kind")):
                if row["stamp"] and not (self.again and row["error_kind"] in TRANSIENT):
                    self._done.add(_digest(row["address"], row["stamp"]))

    def has(self, entry: Entry) -> bool:
        """Return whether this file, in its state of now, has a row."""
        return bool(entry.stamp) and _digest(entry.address, entry.stamp) in self._done

    def add(self, row: Row) -> str:
        """Add a record's row, unless it was not selected; return its status."""
        if row["status"] != LEFT_OUT:
            self._waiting.append(row)
            if len(self._waiting) >= PART_ROWS or time.monotonic() - self._written_s > PART_S:
                self.flush()
        return row["status"]

    def flush(self) -> None:
        """Write the rows that wait as a part. Raises InterruptedRunError: the disk refuses."""
        self._written_s = time.monotonic()
        if self._waiting:
            number = 1 + int(([Path("0"), *self._parts()])[-1].stem)
            self._write(self.folder / f"{number:08d}.parquet", [table.rows_to_table(self._waiting)])
            self._waiting = []

    def join(self) -> Counter[str]:
        """Write the output, remove the parts, and count the rows by status.

        Raises InterruptedRunError: the disk refuses; the parts stay.
        """
        self.flush()
        statuses = self._statuses()
        self._write(self.output, self._current(iter(statuses)))
        shutil.rmtree(self.folder, ignore_errors=True)
        return Counter(status for status in statuses if status)

    def _statuses(self) -> list[str | None]:
        """Return the status of each row, the oldest first; None: its file has a newer row."""
        statuses: list[str | None] = []
        places, contents = set[bytes](), set[str]()
        for file in reversed(self._files()):
            for row in reversed(list(table.read_rows(file, ("address", "sha256", "status")))):
                place, status = _digest(row["address"]), row["status"]
                if place in places:
                    status = None
                elif status != "error":
                    status = COPY if row["sha256"] in contents else "ok"
                    contents.add(row["sha256"])
                places.add(place)
                statuses.append(status)
        return statuses[::-1]

    def _current(self, statuses: Iterator[str | None]) -> Iterator[pa.Table]:
        """Yield the rows that have a status, many at a time."""
        column, waiting = table.SCHEMA.get_field_index("status"), [table.SCHEMA.empty_table()]
        for file in self._files():
            with pq.ParquetFile(file) as rows:
                for batch in rows.iter_batches(table.BATCH_ROWS):
                    new = pa.array([next(statuses) for _ in range(len(batch))], pa.string())
                    marked = pa.Table.from_batches([batch]).set_column(column, "status", new)
                    waiting.append(marked.filter(new.is_valid()).cast(table.SCHEMA))
                    if sum(map(len, waiting)) >= GROUP_ROWS:
                        yield pa.concat_tables(waiting)
                        waiting = []
        if waiting:
            yield pa.concat_tables(waiting)

    def _write(self, file: Path, tables: Iterable[pa.Table]) -> None:
        about = {"format": table.FORMAT, "options": json.dumps(self.task.options())}
        schema = table.SCHEMA.with_metadata(about)
        try:
            with whole_path(file) as place, pq.ParquetWriter(place, schema, compression="zstd") as writer:
                for rows in tables:
                    writer.write_table(rows)
        except OSError as error:
            raise InterruptedRunError(f"{file}: {error.strerror}. Make room; the same command goes on.") from None


def _digest(*texts: str) -> bytes:
    """Return sixteen bytes that stand for texts: a run remembers every record."""
    return hashlib.blake2b("\0".join(texts).encode(), digest_size=16).digest()
