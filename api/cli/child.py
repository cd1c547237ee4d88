"""A process that lives no longer than the one that started it: its command, its log, its ready line."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from stimrig.api.cli.errors import LaunchError

READY_S = 60.0
END_S = 6.0
LAST_BYTES = 100_000
"""So much of a log's end is read for a process's last words."""
LIBC = ctypes.CDLL(None, use_errno=True)
PR_SET_PDEATHSIG = 1
ENDINGS = (signal.SIGTERM, signal.SIGINT)


@dataclass
class Child:
    """One process: how it is started, its log, and its ready line."""

    name: str
    command: list[str]
    log: Path
    environment: dict[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    ready: dict[str, Any] = field(default_factory=dict)
    restarts: int = 0
    started_s: float = 0.0
    inherits: tuple[int, ...] = ()
    """Descriptors that it keeps open."""
    _log_start: int = 0

    def start(self) -> dict[str, Any]:
        """Start it and wait for its ready line.

        Raises LaunchError: it ended instead, or said nothing: its own last line is the message.
        """
        line = read_line(self._launch(), READY_S)
        try:
            self.ready = json.loads(line)
        except ValueError:
            raise self.failure() from None
        return self.ready

    def _launch(self) -> subprocess.Popen[bytes]:
        self.started_s = time.monotonic()
        with self.log.open("ab") as log:
            self._log_start = log.tell()
            # A signal comes before there is a process, or when it is known: never between.
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
            try:
                self.process = subprocess.Popen(
                    self.command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env={**os.environ, **self.environment},
                    pass_fds=self.inherits,
                    start_new_session=True,  # Ctrl-C reaches the launcher only, which ends them in order
                    preexec_fn=partial(die_with_parent, os.getpid(), mask),
                )
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        return self.process

    def failure(self) -> LaunchError:
        """Why it is not there, in its own words."""
        assert self.process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(2)
        code = self.process.poll()
        self.end()
        words = self.last_words() or (f"it ended with code {code}" if code is not None else "it did not start in time")
        words = words.removeprefix(f"{self.name}: ").removeprefix("stimrig: ").removeprefix("stimrig emulate: ")
        if code == 2:  # bad input: the words name the place and the fix
            return LaunchError(words, 2)
        return LaunchError(f"{self.name}: {words} (log: {self.log})")

    def last_words(self) -> str:
        """The last line of its log that is meant for people; empty where there is none, or no log any more."""
        try:
            with self.log.open("rb") as log:
                log.seek(max(self._log_start, log.seek(0, os.SEEK_END) - LAST_BYTES))
                lines = [line for line in log.read().decode(errors="replace").splitlines() if line.strip()]
        except OSError:
            return ""
        for line in reversed(lines):
            if not line.startswith("{"):
                return line.strip()
        try:
            return str(json.loads(lines[-1])["message"]) if lines else ""
        except (ValueError, KeyError):  # cut off in the middle, as on a disk that is full
            return ""

    def alive(self) -> bool:
        """Whether it runs."""
        return self.process is not None and self.process.poll() is None

    def end(self, limit_s: float = END_S) -> None:
        """SIGTERM, and SIGKILL if that was not heard."""
        if self.process is None:
            return
        self.process.terminate()
        try:
            self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def cpu_s(self) -> float | None:
        """Processor time used so far, s; None where the system does not tell."""
        try:
            assert self.process is not None
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        except (OSError, AssertionError, IndexError):
            return None


def die_with_parent(parent: int, mask: Iterable[int]) -> None:
    """In the child, before it becomes another program: end when the launcher does, and at once if it has ended.

    Until here a signal would have been taken by the launcher's handler, of which the other program knows nothing.
    """
    for number in ENDINGS:
        signal.signal(number, signal.SIG_DFL)
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(1)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def read_line(process: subprocess.Popen[bytes], limit_s: float) -> str:
    """The first line a process prints, or an empty string at its end or at the limit."""
    assert process.stdout is not None
    end, text = time.monotonic() + limit_s, b""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while not text.endswith(b"\n") and time.monotonic() < end:
            if not selector.select(0.2):
                continue
            piece = os.read(process.stdout.fileno(), 65536)
            if not piece:
                break
            text += piece
    return text.decode(errors="replace").partition("\n")[0]
