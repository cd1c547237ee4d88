"""Results on disk: parts beside the output while the run goes on, one file in the end; nothing doubled, nothing lost.

`RESULTS.parquet.parts/` holds `run.json` (the options), a lock, and parts, each written whole or not at all. A run that
is cut off leaves its parts; the next one with the same options reads which records are done and goes on. The end joins
them, with the rows of an earlier output, into one file that takes the output's place at once.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Self

import pyarrow.parquet as pq

from stimrig.api.cohort import table
from stimrig.api.cohort.computing import COPY, LEFT_OUT, digest
from stimrig.api.cohort.sources import Entry
from stimrig.api.cohort.tasks import CohortError, CutOffError, Task, differing
from stimrig.api.whole_file import whole_file

ROWS_A_PART = 500
MOST_ALIKE = 1000
KNOWN = ("ok", COPY)
"""Of a content with a result no other is needed. Each file that failed has its own row: somebody looks for it."""
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
        if row.get("sha256") and row["status"] in KNOWN:
            self.contents.add(digest(row["sha256"]))
        if row.get("stamp"):
            self.places.add(digest(row["address"], row["stamp"]))

    def read(self, row: dict[str, Any]) -> None:
        """Take in the keys of a row of an earlier run."""
        self.add(row)
        if row["sha256"] and row["status"] in KNOWN and row["bytes"] is not None:
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
            if not self._parts() and not (self.folder / "run.json").exists():
                shutil.rmtree(self.folder, ignore_errors=True)
            self._let_go()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
            if self.folder.exists() and not self._parts():  # nothing is done: nothing to go on from
                shutil.rmtree(self.folder, ignore_errors=True)
        finally:
            self._let_go()

    def _let_go(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _begin(self) -> None:
        """Compare the options with those of what is there, and read which records are done."""
        about = self.folder / "run.json"
        before = table.options_of(self.output) if self.output.exists() else None
        for place, options in ((self.output, before), (about, _stored(about))):
            if options is not None and (differs := differing(options, self.task.document())):
                raise CohortError(f"{place}: made with other options ({differs}). Give another -o, or remove it.")
        with whole_file(about) as file:
            file.write(json.dumps(self.task.document()).encode())
        for part in self.folder.glob(".*.new"):
            part.unlink()  # half-written by a run that was cut off
        parts = self._parts()
        self._next = 1 + max((int(part.stem) for part in parts), default=-1)
        for file in (*([self.output] if self.output.exists() else []), *parts):
            for row in table.rows_of(file, table.KEYS):
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
        """Bring what waits to the disk, as a part of its own. Raises CutOffError: the disk does not take it."""
        if not self.waiting:
            return
        with self._kept(self.folder), whole_file(self.folder / f"{self._next:08d}.parquet") as file:
            pq.write_table(table.table_of(self.waiting), file, compression="zstd")
        self._next += 1
        self.waiting = []

    def join(self) -> dict[str, int]:
        """Write the output and take the parts away; rows by status.

        Raises CutOffError: the disk does not take it; the parts stay.
        """
        self.flush()
        files = [*([self.output] if self.output.exists() else []), *self._parts()]
        kept, counts = table.kept_rows(files)
        options = json.dumps(self.task.document())
        about = {"format": table.FORMAT, "format_version": table.FORMAT_VERSION, "options": options}
        with (
            self._kept(self.output),
            whole_file(self.output) as file,
            pq.ParquetWriter(file, table.SCHEMA.with_metadata(about), compression="zstd") as writer,
        ):
            for group in table.groups(files, kept):
                writer.write_table(group)
        shutil.rmtree(self.folder, ignore_errors=True)
        return counts

    @contextmanager
    def _kept(self, place: Path) -> Iterator[None]:
        """Around what is written: a disk that does not take it ends the run, and the parts stay. Raises CutOffError."""
        try:
            yield
        except OSError as error:
            raise CutOffError(f"{place}: {error.strerror}. Make room; the same command goes on.") from None


def _stored(about: Path) -> dict[str, Any] | None:
    """The options of parts; None where there are none."""
    try:
        return dict(json.loads(about.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError):
        raise CohortError(f"{about}: cannot be read. Remove the folder {about.parent} to begin anew.") from None
