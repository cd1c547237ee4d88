"""Results on disk: parts beside the output while the run goes on, joined into one file in the end.

`RESULTS.parquet.parts/` holds a lock and parts, each written whole or not at all, with the options of the run. The next
run with the same options skips the records that have a row, in the output or in a part.
"""

from __future__ import annotations

import fcntl
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Self

import pyarrow as pa
import pyarrow.parquet as pq

from stimrig.api.cohort import table
from stimrig.api.cohort.errors import CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT, Row
from stimrig.api.cohort.sources import Entry
from stimrig.api.cohort.task import Task, describe_differences
from stimrig.api.cohort.worker import COPY, digest
from stimrig.api.whole_file import whole_file

PART_ROWS = 500
PART_S = 10.0
"""What a run that is killed loses at most."""
GROUP_ROWS = 5000
MAX_CONTENTS = 1000
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
        self._places: set[bytes] = set()  # of files in the state in which they were done
        self._contents: dict[int, list[bytes]] = {}  # with a result, by size
        self._copied: set[bytes] = set()  # contents that this run found at another address, too
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
        if not any(self.folder.glob("[0-9]*.parquet")):  # nothing to resume from
            shutil.rmtree(self.folder, ignore_errors=True)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _files(self) -> list[Path]:
        """List the files with rows, the oldest first."""
        return [*([self.output] if self.output.exists() else []), *sorted(self.folder.glob("[0-9]*.parquet"))]

    def _read(self) -> None:
        """Compare the options, and read which records are done."""
        for file in self._files():
            if differences := describe_differences(table.read_options(file), self.task.options()):
                raise CohortError(f"{file}: made with other options ({differences}). Give another -o, or remove it.")
            for row in table.read_rows(file, (*table.KEYS, "status", "error_kind")):
                if not (self.again and row["error_kind"] in TRANSIENT):
                    self._remember(row)

    def _remember(self, row: Row) -> None:
        if row.get("stamp"):
            self._places.add(digest(row["address"], row["stamp"]))
        if row["status"] == "ok":
            self._contents.setdefault(row["bytes"], []).append(digest(row["sha256"]))

    def has(self, entry: Entry) -> bool:
        """Return whether this file, in its state of now, has a row."""
        return bool(entry.stamp) and digest(entry.address, entry.stamp) in self._places

    def contents(self, entry: Entry) -> list[bytes]:
        """Return digests of contents with a result that this file may be a copy of."""
        return self._contents.get(entry.size or 0, [])[:MAX_CONTENTS]

    def add(self, row: Row) -> str:
        """Add a record's row; return its status, which is `copy` if its content has a result already."""
        if row["status"] == LEFT_OUT:
            return LEFT_OUT
        content = digest(row.get("sha256") or "")
        if row["status"] == COPY or content in self._contents.get(row.get("bytes", -1), []):
            self._copied.add(content)
            return COPY
        self._remember(row)
        self._waiting.append(row)
        if len(self._waiting) >= PART_ROWS or time.monotonic() - self._written_s > PART_S:
            self.flush()
        return row["status"]

    def flush(self) -> None:
        """Write the rows that wait as a part. Raises InterruptedRunError: the disk refuses."""
        self._written_s = time.monotonic()
        if self._waiting:
            parts = sorted(self.folder.glob("[0-9]*.parquet"))
            number = 1 + int(parts[-1].stem) if parts else 0
            self._write(self.folder / f"{number:08d}.parquet", iter([table.rows_to_table(self._waiting)]))
            self._waiting = []

    def join(self) -> Counter[str]:
        """Write the output, remove the parts, and count the rows by status.

        Raises InterruptedRunError: the disk refuses; the parts stay.
        """
        self.flush()
        counts: Counter[str] = Counter()
        self._write(self.output, self._current(counts))
        shutil.rmtree(self.folder, ignore_errors=True)
        return counts

    def _write(self, file: Path, tables: Iterator[pa.Table]) -> None:
        about = {"format": table.FORMAT, "format_version": table.FORMAT_VERSION}
        schema = table.SCHEMA.with_metadata(about | {"options": json.dumps(self.task.options())})
        try:
            with whole_file(file) as place, pq.ParquetWriter(place, schema, compression="zstd") as writer:
                for rows in tables:
                    writer.write_table(rows)
        except OSError as error:
            raise InterruptedRunError(f"{file}: {error.strerror}. Make room; the same command goes on.") from None

    def _current(self, counts: Counter[str]) -> Iterator[pa.Table]:
        """Yield the rows that count, many at a time, and count them."""
        current = self._current_rows()
        waiting = [table.SCHEMA.empty_table()]
        for file in self._files():
            with pq.ParquetFile(file) as rows:
                for batch in rows.iter_batches(table.BATCH_ROWS):
                    counted = pa.array([next(current) for _ in range(len(batch))])
                    current_rows = pa.Table.from_batches([batch]).filter(counted).cast(table.SCHEMA)
                    counts.update(current_rows["status"].to_pylist())
                    waiting.append(current_rows)
                    if sum(map(len, waiting)) >= GROUP_ROWS:
                        yield pa.concat_tables(waiting)
                        waiting = []
        if waiting:
            yield pa.concat_tables(waiting)

    def _current_rows(self) -> Iterator[bool]:
        """Yield for each row whether it counts, the oldest first: the newest of its address and of its content.

        A file that was replaced takes its old row with it, unless the old content lies elsewhere, too.
        """
        current: list[bool] = []
        places, contents = set[bytes](), set[bytes]()
        for file in reversed(self._files()):
            for row in reversed(list(table.read_rows(file, ("address", "sha256", "status")))):
                place, content = digest(row["address"]), digest(row["sha256"] or "")
                replaced = place in places and not (row["status"] == "ok" and content in self._copied)
                current.append(not replaced and content not in contents)
                if file != self.output:  # of its rows none replaced another one
                    places.add(place)
                if row["status"] == "ok":
                    contents.add(content)
        return reversed(current)
