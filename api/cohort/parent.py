"""A worker's process that computes: started when first needed, ended when it hangs, and again after some records."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict
from multiprocessing.util import Finalize
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from stimrig.api.cohort.sources import SUFFIXES, Entry
from stimrig.api.cohort.tasks import Task
from stimrig.api.workers.process import environment
from stimrig.identify.json_text import BadJson, parse

RECORDS_A_PROCESS = 500
"""After so many a fresh process is started: what a library never gives back cannot add up."""
START_S = 300.0
"""So long a start may take on a busy machine, compiling what was never compiled there."""
CHILD = (sys.executable, "-m", "stimrig.api.cohort.child")
LONGEST_BYTES, DEEPEST = 16 * 2**20, 20
"""Of an answer: a process that a record has taken over could talk without an end."""
NO_ANSWER = {"status": "error", "error_kind": "unexpected", "error": "its process gave an answer that cannot be read."}
PREFIX, LOCK = "stimrig-cohort-", "lock"


class Computing:
    """One process that computes, for one thread of a worker.

    Parameters
    ----------
    memory_bytes : int
        What a record may take beyond the libraries.
    records : int
        After so many the process is started afresh.
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
        call = {"file": file.name, "name": entry.name, "known": entry.known, "task": asdict(task), "limit_s": limit_s}
        try:
            return self._asked(json.dumps(call).encode() + b"\n", entry, limit_s)
        finally:
            file.unlink(missing_ok=True)

    def _asked(self, call: bytes, entry: Entry, limit_s: float) -> dict[str, Any]:
        process = self._running()
        assert process.stdin is not None
        try:
            process.stdin.write(call)
            process.stdin.flush()
        except BrokenPipeError:  # it ended since its last record, for nobody had called for long
            self.close_process()
            process = self._running()
            assert process.stdin is not None
            process.stdin.write(call)
            process.stdin.flush()
        began_s = time.monotonic()
        line = self._line(process, limit_s)
        took_s = round(time.monotonic() - began_s, 3)
        if line is not None and (found := _sound(line)) is not None:
            self.done += 1
            return found
        code = self.close_process()
        ended = _ended(code, took_s, limit_s) if line is None else NO_ANSWER
        return {"row": {**entry.known, **ended, "took_s": took_s}}

    def _running(self) -> subprocess.Popen[bytes]:
        """The process, fresh where there is none or where it has done enough."""
        if self.process is not None and (
            self.done >= self.records or self.process.poll() is not None or self._spoke(self.process)
        ):
            self.close_process()
        if self.process is None:
            self.process = subprocess.Popen(
                [*CHILD, "--folder", str(self._folder), "--memory", str(self.memory_bytes)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**environment(), **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")},
                start_new_session=True,  # Ctrl-C ends the run in order
            )
            self.done, self._rest = 0, b""
            ready = self._line(self.process, START_S)
            if ready is None:
                code = self.close_process()
                raise RuntimeError(f"the process that computes does not start ({_how(code)})")
            self.left_open = json.loads(ready)["left_open"]
        return self.process

    def _spoke(self, process: subprocess.Popen[bytes]) -> bool:
        """Whether it says something that nobody asked: it would be taken for the answer on the next record."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as ready:
            ready.register(process.stdout, selectors.EVENT_READ)
            return bool(self._rest or ready.select(0))

    def _line(self, process: subprocess.Popen[bytes], patience_s: float) -> bytes | None:
        """The next line; None where the process ended, or none came in time."""
        assert process.stdout is not None
        until_s = time.monotonic() + patience_s
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
        """End the process and take away its folder."""
        self.close_process()
        self._lock.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def _sound(line: bytes) -> dict[str, Any] | None:
    """An answer as the child gives them; None of anything else."""
    try:
        found = parse(line, deepest=DEEPEST, finite=False)
    except BadJson:
        return None
    row = found.get("row") if isinstance(found, dict) else None
    if isinstance(row, dict) and row.get("status") in ("ok", "error"):
        return {"row": row}
    return {"left_out": True} if found == {"left_out": True} else None


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


def _ended(code: int | None, took_s: float, limit_s: float) -> dict[str, Any]:
    """The columns of a record whose process gave no answer."""
    if code is None:
        kind, line = "timeout", f"ended after {limit_s:g} s. Give more with --limit, or cut the record."
    elif code == -signal.SIGXCPU:
        kind, line = "timeout", f"ended after {took_s:.0f} s of computing. Give more with --limit, or cut the record."
    elif code == -signal.SIGKILL:
        kind, line = "killed", "its process was killed from outside, or by the system for want of memory."
    else:
        kind, line = "killed", f"its process ended ({_how(code)})."
    return {"status": "error", "error_kind": kind, "error": line}


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
