"""What a worker of Dask does with a record: fetch it, hash it, have it computed; a row in any case.

The worker itself never looks into a record: that is done by a process that is shut in (`api.cohort.record`), started
when first needed, ended when it hangs, and again after some records.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import secrets
import selectors
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from multiprocessing.util import Finalize
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from stimrig.api.cohort.sources import SUFFIXES, Entry, Source, SourceError
from stimrig.api.cohort.tasks import Task
from stimrig.api.version import software_version
from stimrig.api.workers.process import WORKER, environment
from stimrig.identify.json_text import BadJson, parse
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES

RECORDS_A_PROCESS = 500
"""After so many a fresh process is started: what a library never gives back cannot add up."""
START_S = 300.0
"""So long a start may take on a busy machine, compiling what was never compiled there."""
IDLE_S = 600.0
"""A worker that outlives the run keeps no process for longer."""
CHILD = (*WORKER, "--verbs", "stimrig.api.cohort.record", "--nice", "0", "--idle-s", f"{IDLE_S}")
LONGEST_BYTES, DEEPEST = 16 * 2**20, 21
"""Of an answer: a process that a record has taken over could talk without an end."""
PREFIX, LOCK = "stimrig-cohort-", "lock"
LEFT_OUT, COPY = "left out", "copy"
"""Status of rows that are kept until the end, so that a record is not read again, and not handed out."""
MINE = ("address", "stamp", "sha256", "bytes", "verb", "software", "origin")
"""Columns that a record has no say in."""
TOO_LARGE = f"more than {LARGEST_FILE_BYTES // 2**20} MB. Cut the record, or give the sealed recording."


@dataclass(frozen=True)
class Bounds:
    """What one record may take: seconds, bytes beyond the libraries; and after how many records a process ends."""

    limit_s: float
    memory_bytes: int
    records: int


Record = tuple[Source, Entry, tuple[bytes, ...]]
"""A record, and digests of contents that it need not be computed again."""


@dataclass(frozen=True)
class Done:
    """What a worker did of a parcel: the rows of its first records, and how long that took."""

    rows: list[dict[str, Any]]
    took_s: float
    other_version: str = ""
    """The worker's version, where it is another than that of who asks; then there are no rows."""


def run_parcel(records: list[Record], task: Task, bounds: Bounds, patience_s: float) -> Done:
    """Records one after the other, the first in any case, until `patience_s` is over; the others are not begun."""
    began_s, rows = time.monotonic(), list[dict[str, Any]]()
    if software_version() != task.software:
        return Done(rows, 0.0, software_version())
    for source, entry, done in records:
        rows.append(run_record(source, entry, task, bounds, done))
        if time.monotonic() - began_s > patience_s:
            break
    return Done(rows, time.monotonic() - began_s)


def run_record(
    source: Source, entry: Entry, task: Task, bounds: Bounds, done: tuple[bytes, ...] = ()
) -> dict[str, Any]:
    """One record's row; its `status` is `ok`, `error`, `left out` of the selection, or `copy` of what is in `done`."""
    base: dict[str, Any] = {**entry.known, **identity(entry), "verb": task.verb, "software": task.software}
    if entry.bytes is not None and entry.bytes > LARGEST_FILE_BYTES:
        return {**base, **_failed("bad record", TOO_LARGE)}
    try:
        content = source.open(entry, LARGEST_FILE_BYTES)
    except SourceError as error:
        return {**base, **_failed("unreadable", str(error))}
    if len(content) > LARGEST_FILE_BYTES:
        return {**base, **_failed("bad record", TOO_LARGE)}
    sha256 = hashlib.sha256(content).hexdigest()
    base |= {"bytes": len(content), "sha256": sha256}
    if done and digest(sha256) in done:
        return {**base, "status": COPY}
    process = computing(bounds.memory_bytes, bounds.records)
    row = process.compute(content, entry, task, bounds.limit_s).get("row", {"status": LEFT_OUT})
    mine = {name: base[name] for name in MINE if name in base}  # whatever the process says
    return {**base, **row, **mine, "left_open": process.left_open}


def digest(*words: str) -> bytes:
    """Sixteen bytes that stand for texts: a cohort may have millions of records."""
    return hashlib.blake2b("\0".join(words).encode("utf-8", "replace"), digest_size=16).digest()


def identity(entry: Entry) -> dict[str, Any]:
    """What tells a record from all others, and its content of now from that of another time."""
    return {"address": entry.address, "stamp": entry.stamp}


def _failed(kind: str, line: str, took_s: float = 0.0) -> dict[str, Any]:
    return {"status": "error", "error_kind": kind, "error": line, "took_s": took_s}


def lost(entry: Entry, task: Task, line: str) -> dict[str, Any]:
    """The row of a record with which its worker was lost."""
    base = {**entry.known, **identity(entry), "verb": task.verb, "software": task.software}
    return {**base, **_failed("killed", line)}


class Computing:
    """One process that computes, for one thread of a worker.

    `memory_bytes`: what a record may take beyond the libraries; `records`: after so many the process is started afresh.
    """

    def __init__(self, memory_bytes: int, records: int = RECORDS_A_PROCESS) -> None:
        self.memory_bytes, self.records = memory_bytes, records
        self.process: subprocess.Popen[bytes] | None = None
        self.done = 0
        self.left_open: dict[str, str] = {}
        """What the process could not be shut in from, and why."""
        self._rest = b""
        tidy()
        self._folder, self._lock = make_folder()

    def compute(self, content: bytes, entry: Entry, task: Task, limit_s: float) -> dict[str, Any]:
        """The row of a record, `{"left_out": True}` where it is not meant; how the process ended is a row, too."""
        suffix = PurePosixPath(entry.name).suffix.lower()
        file = self._folder / f"record{suffix if suffix in SUFFIXES else ''}"
        file.write_bytes(content)
        number = secrets.token_hex(8)  # nobody can have answered before
        arguments = {"file": str(file), "name": entry.name, "known": entry.known, "task": asdict(task)}
        processor_s = 2 * limit_s  # it is ended sooner; this is for when nobody is there to do it
        call = {"call": number, "verb": "compute", "arguments": arguments, "processor_s": processor_s}
        try:
            process = self._send(json.dumps(call).encode() + b"\n")
            began_s = time.monotonic()
            found = self._answer(process, number, began_s + limit_s)
            took_s = round(time.monotonic() - began_s, 3)
            if isinstance(found, dict):
                self.done += 1
                return found
            code = self.close_process()
            kind, line = _ended(code, took_s, limit_s) if found is None else ("unexpected", found)
            return {"row": {**entry.known, **_failed(kind, line, took_s)}}
        finally:
            file.unlink(missing_ok=True)

    def _send(self, call: bytes) -> subprocess.Popen[bytes]:
        """To the process; to a fresh one where it ended since its last record, for nobody had called for long."""
        try:
            return self._write(call)
        except BrokenPipeError:
            self.close_process()
            return self._write(call)

    def _write(self, call: bytes) -> subprocess.Popen[bytes]:
        process = self._running()
        assert process.stdin is not None
        process.stdin.write(call)
        process.stdin.flush()
        return process

    def _answer(self, process: subprocess.Popen[bytes], number: str, until_s: float) -> dict[str, Any] | str | None:
        """What a call gave; a line of words where it is none, None where the process ended, or none came in time."""
        while (line := self._line(process, until_s)) is not None:
            try:
                message: Any = parse(line, deepest=DEEPEST, finite=False)
            except BadJson:
                break
            if not isinstance(message, dict) or "call" not in message:
                break
            if message["call"] != number:
                continue  # a second answer on a record before
            found: Any = message.get("result")
            row = found.get("row") if isinstance(found, dict) else None
            if isinstance(row, dict) and row.get("status") in ("ok", "error"):
                return {"row": row}
            if found == {"left_out": True}:
                return found
            break
        return None if line is None else "its process gave an answer that cannot be read."

    def _running(self) -> subprocess.Popen[bytes]:
        """The process, fresh where there is none or where it has done enough."""
        if self.process is not None and (
            self.done >= self.records or self.process.poll() is not None or self._spoke(self.process)
        ):
            self.close_process()
        if self.process is None:
            self.process = subprocess.Popen(
                [*CHILD, "--reads", str(self._folder), "--memory", str(self.memory_bytes)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**environment(), **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")},
                start_new_session=True,  # Ctrl-C ends the run in order
            )
            self.done, self._rest = 0, b""
            ready = self._line(self.process, time.monotonic() + START_S)
            if ready is None:
                code = self.close_process()
                raise RuntimeError(f"the process that computes does not start ({_how(code)})")
            self.left_open = json.loads(ready)["left_open"]
        return self.process

    def _spoke(self, process: subprocess.Popen[bytes]) -> bool:
        """Whether it says something that nobody asked: it would spoil the row of the next record."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as ready:
            ready.register(process.stdout, selectors.EVENT_READ)
            return bool(self._rest or ready.select(0))

    def _line(self, process: subprocess.Popen[bytes], until_s: float) -> bytes | None:
        """The next line; None where the process ended, or none came in time."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as ready:
            ready.register(process.stdout, selectors.EVENT_READ)
            while b"\n" not in self._rest:
                left_s = until_s - time.monotonic()
                if left_s <= 0 or not ready.select(left_s):
                    return None
                piece = os.read(process.stdout.fileno(), 1 << 16)
                if not piece:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(5)
                    return None
                self._rest += piece
                if len(self._rest) > LONGEST_BYTES:
                    return b""
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def close_process(self) -> int | None:
        """End the process; the code with which it had ended by itself, None where it had not."""
        process, self.process = self.process, None
        if process is None:
            return None
        code = process.poll()
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        return code

    def close(self) -> None:
        self.close_process()
        self._lock.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def make_folder() -> tuple[Path, BinaryIO]:
    """A folder for records, with its lock: `tidy` of another worker finds it only once the lock is held."""
    made = Path(tempfile.mkdtemp(prefix=f"new-{PREFIX}"))
    lock = (made / LOCK).open("wb")
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return made.rename(made.with_name(made.name.removeprefix("new-"))), lock


def tidy() -> None:
    """Take away what workers that were killed left of people's records."""
    for lock in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{LOCK}"):
        with contextlib.suppress(OSError), lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held as long as its worker lives
            shutil.rmtree(lock.parent, ignore_errors=True)


def _ended(code: int | None, took_s: float, limit_s: float) -> tuple[str, str]:
    """Kind and words of a record whose process gave no answer."""
    if code is None:
        return "timeout", f"ended after {limit_s:g} s. Give more with --limit, or cut the record."
    if code == -signal.SIGXCPU:
        return "timeout", f"ended after {took_s:.0f} s of computing. Give more with --limit, or cut the record."
    if code == -signal.SIGKILL:
        return "killed", "its process was killed from outside, or by the system for want of memory."
    return "killed", f"its process ended ({_how(code)})."


def _how(code: int | None) -> str:
    if code is not None and code < 0:
        return signal.Signals(-code).name
    return "it hangs" if code is None else f"code {code}"


_of_thread: dict[int, Computing] = {}
_lock = threading.Lock()
_at_the_end: list[Finalize] = []


def computing(memory_bytes: int, records: int = RECORDS_A_PROCESS) -> Computing:
    """The process of this thread of the worker."""
    with _lock:
        known = _of_thread.get(threading.get_ident())
        if known is not None and (known.memory_bytes, known.records) != (memory_bytes, records):
            known.close()
            known = None
        if not _at_the_end:
            _at_the_end.append(Finalize(None, close_all, exitpriority=10))  # as this worker ends, in either way
        if known is None:
            known = _of_thread[threading.get_ident()] = Computing(memory_bytes, records)
        return known


def close_all() -> None:
    """End every process of this worker: a worker that stays keeps none."""
    with _lock:
        while _of_thread:
            _of_thread.popitem()[1].close()
