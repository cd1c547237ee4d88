"""Results on disk: parts beside the output while the run goes on, one file in the end; nothing doubled, nothing lost.

`RESULTS.parquet.parts/` holds `run.json` (the options), a lock, and parts, each written whole or not at all. A run that
is cut off leaves its parts; the next one with the same options reads which records are done and goes on. The end joins
them, with the rows of an earlier output, into one file that takes the output's place at once.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Self

import pyarrow as pa
import pyarrow.parquet as pq

from api.cohort.errors import CohortError, CutOffError
from api.cohort.sources import Entry
from api.cohort.table import FORMAT, FORMAT_VERSION, SCHEMA, table_of
from api.cohort.tasks import Task
from api.cohort.worker import COPY, LEFT_OUT, digest

ROWS_A_PART = 500
MOST_ALIKE = 1000
ROWS_A_GROUP = 5000
ROWS_AT_ONCE = 1000
"""Rows held in memory while parts are joined."""
KEYS = ("sha256", "address", "stamp", "bytes", "status", "error_kind")
AGAIN = ("timeout", "killed", "out of memory", "unreadable", "unexpected")
"""Errors that another try may not meet again (`--again`)."""


@dataclass
class Done:
    """Which records are done, by content and by where they lie."""

    contents: set[bytes] = field(default_factory=set)
    places: set[bytes] = field(default_factory=set)
    earlier: dict[int, list[bytes]] = field(default_factory=dict)
    """Contents of runs before this one, by their size: a worker need not do again what only lies elsewhere now."""

    def add(self, row: dict[str, Any]) -> None:
        """Take in a row's keys."""
        if row.get("sha256") and row["status"] != LEFT_OUT:
            self.contents.add(digest(row["sha256"]))
        if row.get("stamp"):
            self.places.add(digest(row["address"], row["stamp"]))

    def read(self, row: dict[str, Any]) -> None:
        """Take in the keys of a row of an earlier run."""
        self.add(row)
        if row["sha256"] and row["status"] != LEFT_OUT and row["bytes"] is not None:
            self.earlier.setdefault(row["bytes"], []).append(digest(row["sha256"]))

    def has_place(self, entry: Entry) -> bool:
        """Whether this file, in the state in which it is listed, is done."""
        return bool(entry.stamp) and digest(entry.address, entry.stamp) in self.places

    def has_content(self, sha256: str) -> bool:
        """Whether this content is done, wherever it lay."""
        return bool(sha256) and digest(sha256) in self.contents

    def alike(self, entry: Entry) -> tuple[bytes, ...]:
        """Contents of earlier runs with the file's size, for the worker to compare; none where they are too many."""
        found = self.earlier.get(-1 if entry.bytes is None else entry.bytes, [])
        return tuple(found) if len(found) <= MOST_ALIKE else ()


class Results:
    """The results of one run. Use it in a `with` statement: it holds the lock.

    Parameters
    ----------
    output : Path
        The Parquet file to be.
    task : Task
        With the options that all rows share.
    again : bool
        Whether records that failed for a reason that may have passed are to be done again.

    Raises
    ------
    CohortError
        The place cannot be written, another run writes it, or what is there was made with other options.
    """

    def __init__(self, output: Path, task: Task, again: bool = False) -> None:
        self.output, self.task, self.again = output, task, again
        self.folder = output.with_name(output.name + ".parts")
        self.done = Done()
        self.waiting: list[dict[str, Any]] = []
        self._lock: IO[bytes] | None = None
        self._next = 0

    def __enter__(self) -> Self:
        if self.output.is_dir():
            raise CohortError(f"{self.output}: a folder. Give a file.")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / "lock").open("ab")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._let_go()
            raise CohortError(f"{self.output}: another run writes it now. Wait for it, or give another -o.") from None
        except OSError as error:
            self._let_go()
            raise CohortError(
                f"{self.folder}: {error.strerror}. Give a file in a folder that can be written."
            ) from None
        try:
            self._begin()
        except BaseException:
            self._let_go()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
        finally:
            self._let_go()

    def _let_go(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _begin(self) -> None:
        """Compare the options with those of what is there, and read which records are done."""
        about = self.folder / "run.json"
        for place, options in ((self.output, options_of(self.output)), (about, _stored(about))):
            if options is not None and (differs := self.task.differs(options)):
                raise CohortError(f"{place}: made with other options ({differs}). Give another -o, or remove it.")
        _whole(about, json.dumps(self.task.document()).encode())
        for part in self.folder.glob("*.new"):
            part.unlink()  # half-written by a run that was cut off
        parts = self._parts()
        self._next = 1 + max((int(part.stem) for part in parts), default=-1)
        for file in (*([self.output] if self.output.exists() else []), *parts):
            for row in rows_of(file, KEYS):
                if not (self.again and row["status"] == "error" and row["error_kind"] in AGAIN):
                    self.done.read(row)

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.parquet"))

    def add(self, row: dict[str, Any]) -> str:
        """Take in a row; its status: a content that is there already becomes a copy."""
        if self.done.has_content(row.get("sha256") or "") and row["status"] != LEFT_OUT:
            row = {key: row.get(key) for key in ("sha256", "address", "name", "stamp", "bytes")} | {"status": COPY}
        self.done.add(row)
        self.waiting.append(row)
        if len(self.waiting) >= ROWS_A_PART:
            self.flush()
        return row["status"]

    def flush(self) -> None:
        """Bring what waits to the disk, as a part of its own.

        Raises
        ------
        CutOffError
            The disk does not take it.
        """
        if not self.waiting:
            return
        sink = pa.BufferOutputStream()
        pq.write_table(table_of(self.waiting), sink, compression="zstd")
        try:
            _whole(self.folder / f"{self._next:08d}.parquet", sink.getvalue().to_pybytes())
        except OSError as error:
            raise CutOffError(f"{self.folder}: {error.strerror}. Make room; the same command goes on.") from None
        self._next += 1
        self.waiting = []

    def join(self) -> dict[str, int]:
        """Write the output and take the parts away; rows by status.

        Raises
        ------
        CutOffError
            The disk does not take it; the parts stay.
        """
        self.flush()
        files = [*([self.output] if self.output.exists() else []), *self._parts()]
        kept, counts = _kept(files)
        target = self.output.with_name(f".{self.output.name}.new")
        about = {"format": FORMAT, "format_version": FORMAT_VERSION, "options": json.dumps(self.task.document())}
        try:
            with pq.ParquetWriter(target, SCHEMA.with_metadata(about), compression="zstd") as writer:
                for group in _groups(files, kept):
                    writer.write_table(group)
            with target.open("rb") as file:
                os.fsync(file.fileno())
            target.replace(self.output)
        except OSError as error:
            target.unlink(missing_ok=True)
            raise CutOffError(f"{self.output}: {error.strerror}. Make room; the same command goes on.") from None
        shutil.rmtree(self.folder, ignore_errors=True)
        return counts


def _kept(files: Sequence[Path]) -> tuple[set[int], dict[str, int]]:
    """Numbers of the rows to hand out: the last one of each content and of each place; and how many are what.

    A file that was replaced by another takes its old row with it, unless the old content lies elsewhere, too.
    """
    by_content: dict[bytes, int] = {}
    by_place: dict[bytes, int] = {}
    statuses: dict[int, str] = {}
    replaced: dict[int, str] = {}
    copies: dict[bytes, bytes] = {}
    for number, row in enumerate(row for file in files for row in rows_of(file, KEYS)):
        place = digest(row["address"])
        if row["status"] == COPY:
            copies[place] = digest(row["sha256"])
        elif row["status"] != LEFT_OUT:
            content = digest(row["sha256"]) if row["sha256"] else place
            statuses.pop(by_content.get(content, -1), None)
            if (old := by_place.get(place, -1)) in statuses:
                replaced[old] = statuses.pop(old)
            by_content[content] = by_place[place] = number
            statuses[number] = row["status"]
    lying = {by_content.get(content, -1) for content in copies.values()}
    statuses |= {number: status for number, status in replaced.items() if number in lying}
    counts = {word: sum(1 for status in statuses.values() if status == word) for word in ("ok", "error")}
    return set(statuses), {**counts, "copies": len(copies)}


def rows_of(file: Path, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of a table, some at a time.

    Raises
    ------
    CohortError
        It is damaged, or no such table.
    """
    try:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(ROWS_AT_ONCE, columns=list(columns)):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise CohortError(f"{file}: cannot be read ({' '.join(str(error).split())[:200]}).") from None


def rows_in(file: Path) -> int:
    """How many rows a table has."""
    return pq.read_metadata(file).num_rows


def _groups(files: Sequence[Path], kept: set[int]) -> Iterator[pa.Table]:
    """The rows that are kept, so many at a time."""
    number, waiting = 0, [SCHEMA.empty_table()]
    for file in files:
        with pq.ParquetFile(file) as table:
            for batch in table.iter_batches(ROWS_AT_ONCE):
                rows = [index for index in range(batch.num_rows) if number + index in kept]
                waiting.append(
                    pa.Table.from_batches([batch]).select(SCHEMA.names).cast(SCHEMA).take(pa.array(rows, pa.int64()))
                )
                number += batch.num_rows
                if sum(part.num_rows for part in waiting) >= ROWS_A_GROUP:
                    yield pa.concat_tables(waiting)
                    waiting = []
    if waiting:
        yield pa.concat_tables(waiting)


def options_of(file: Path) -> dict[str, Any] | None:
    """The options that a table of results was made with; None where there is no file.

    Raises
    ------
    CohortError
        It is no table of results.
    """
    if not file.exists():
        return None
    fix = "Give a file written by `stimrig cohort fit`, `diagnose` or `improve`."
    try:
        about = pq.read_schema(file).metadata or {}
        if about.get(b"format") != FORMAT.encode():
            raise CohortError(f"{file}: Parquet, but no results of a cohort. {fix}")
        if about.get(b"format_version") != FORMAT_VERSION.encode():
            raise CohortError(f"{file}: format version {about.get(b'format_version', b'?').decode()}. Update stimrig.")
        return dict(json.loads(about[b"options"]))
    except (pa.ArrowException, OSError, KeyError, ValueError, TypeError) as error:
        raise CohortError(f"{file}: no table of results ({' '.join(str(error).split())[:120]}). {fix}") from None


def _stored(about: Path) -> dict[str, Any] | None:
    """The options of parts; None where there are none."""
    try:
        return dict(json.loads(about.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError):
        raise CohortError(f"{about}: cannot be read. Remove the folder {about.parent} to begin anew.") from None


def _whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, and to the disk."""
    new = path.with_name(path.name + ".new")
    with new.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    with contextlib.suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
