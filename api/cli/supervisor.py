"""Emulator, rig and service as processes that live and die together: `Services` starts, watches and ends them.

The rig is started again when it dies (it comes up uncertain and waits for a person), the service too. None outlives the
supervisor: SIGTERM and Ctrl-C end them in order, and the kernel ends those that are left when the supervisor is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from stimrig.api import owner_only
from stimrig.api.cli.errors import LaunchError
from stimrig.api.settings import Settings
from stimrig.api.store.service_lock import INHERITED, HeldError, reserve

READY_S, END_S, SEAL_S = 60.0, 6.0, 35.0
"""The rig may still have a test to seal."""
RESTART_S, LASTING_S = (0.2, 0.5, 1.0, 2.0, 5.0), 60.0
"""Pauses before the starts in a row of a process that lives shorter than the second."""
LAST_BYTES = 100_000
ENDINGS = (signal.SIGTERM, signal.SIGINT)
LIBC = ctypes.CDLL(None, use_errno=True)
PR_SET_PDEATHSIG = 1


def on_endings(handler: Any) -> dict[signal.Signals, Any]:
    """Set what SIGTERM and Ctrl-C do; return what they did. Only the main thread may."""
    main = threading.current_thread() is threading.main_thread()
    return {number: signal.signal(number, handler) for number in ENDINGS} if main else {}


def raise_once(_number: int, _frame: object) -> None:
    """Interrupt what is going on; further signals do not interrupt the ending."""
    on_endings(signal.SIG_IGN)
    raise KeyboardInterrupt


def die_with_parent(parent: int, mask: Iterable[int]) -> None:
    """In the child, before it becomes another program: end when the parent does, and at once if it has ended.

    Until here a signal would have been taken by the parent's handler, of which the other program knows nothing.
    """
    for number in ENDINGS:
        signal.signal(number, signal.SIG_DFL)
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(1)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@dataclass
class Child:
    """One process: its command, its log, and the JSON line that it prints once it is ready."""

    name: str
    command: list[str]
    log: Path
    environment: dict[str, str] = field(default_factory=dict)
    inherits: tuple[int, ...] = ()
    """Descriptors that it keeps open."""
    process: subprocess.Popen[bytes] | None = None
    ready: dict[str, Any] = field(default_factory=dict)
    restarts: int = 0
    started_s: float = 0.0
    _log_start: int = 0

    def start(self) -> dict[str, Any]:
        """Start it and return its ready line. Raises LaunchError: there is none; its own last line says why."""
        self.started_s = time.monotonic()
        with self.log.open("ab") as log:
            self._log_start = log.tell()
            # A signal comes before there is a process, or when it is known: never between.
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
            try:
                self.process = subprocess.Popen(
                    self.command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log,
                    env=os.environ | self.environment, pass_fds=self.inherits,
                    start_new_session=True,  # Ctrl-C reaches the supervisor only, which ends them in order
                    preexec_fn=partial(die_with_parent, os.getpid(), mask),
                )  # fmt: skip
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        end_s, line, stdout = time.monotonic() + READY_S, b"", self.process.stdout
        assert stdout is not None
        while not line.endswith(b"\n") and select.select([stdout], [], [], max(0.0, end_s - time.monotonic()))[0]:
            piece = os.read(stdout.fileno(), 65536)
            if not piece:
                break
            line += piece
        try:
            self.ready = json.loads(line.partition(b"\n")[0])
        except ValueError:
            raise self.failure() from None
        return self.ready

    def failure(self) -> LaunchError:
        """End it and return why it is not there, in its own words; 2 is bad input, where they name place and fix."""
        assert self.process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(2)
        code = self.process.poll()
        self.end()
        words = self.last_words() or (f"it ended with code {code}" if code is not None else "it did not start in time")
        words = re.sub(rf"^({self.name}: )?(stimrig( emulate)?: )?", "", words)
        return LaunchError(words, 2) if code == 2 else LaunchError(f"{self.name}: {words} (log: {self.log})")

    def last_words(self) -> str:
        """Return the last line that it wrote, if it says why it ended: one for people, or an error of its log."""
        try:
            with self.log.open("rb") as log:
                log.seek(max(self._log_start, log.seek(0, os.SEEK_END) - LAST_BYTES))
                line = log.read().decode(errors="replace").strip().rpartition("\n")[2].strip()
            entry = json.loads(line) if line.startswith("{") else {"level": "error", "message": line}
            return str(entry["message"]) if entry["level"] in ("error", "critical") else ""
        except (OSError, ValueError, KeyError, RecursionError):  # a line is cut off where the disk is full
            return ""

    def alive(self) -> bool:
        """Return whether it runs."""
        return self.process is not None and self.process.poll() is None

    def end(self, limit_s: float = END_S) -> None:
        """Send SIGTERM, and SIGKILL if it has not ended by then."""
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

    def restart(self) -> str:
        """Start it again, and return what happened. Raises LaunchError: it does not stay up."""
        if time.monotonic() - self.started_s > LASTING_S:
            self.restarts = 0
        if self.restarts >= len(RESTART_S):
            raise self.failure()
        time.sleep(RESTART_S[self.restarts])
        self.restarts += 1
        words = self.last_words()
        self.end()
        self.start()
        return f"{self.name} had ended ({words or 'without a message'}) and was started again"


class Services:
    """The whole rig: with no rig file, the emulator stands in for the hardware.

    `admin_token`: set the administrator's token instead of drawing one.
    """

    def __init__(self, settings: Settings, emulate: Sequence[str] = (), admin_token: str | None = None) -> None:
        self.settings, self.admin_token = settings, admin_token
        self._folder_lock: int | None = None
        owner_only.folder(owner_only.folder(settings.data_dir) / settings.logs_dir.name)
        self.runtime = Path(tempfile.mkdtemp(prefix="stimrig-"))  # a Unix socket's path holds 107 characters only
        self.socket = self.runtime / "rig.sock"
        self.emulator: Child | None = None
        if settings.rig_file is None:
            self.emulator = self._child("emulator", "stimrig.hardware_sim", "--die-with-parent", *emulate)
        self.rig, self.api = self._child("rig", "stimrig.rig"), self._child("api", "stimrig.api.web")
        # a rig file names devices of the world, whatever was left in the environment
        self.api.environment["STIMRIG_EMULATED"] = str(self.emulator is not None).lower()
        self.url = ""

    def _child(self, name: str, *module: str) -> Child:
        return Child(name, [sys.executable, "-m", *module], self.settings.logs_dir / f"{name}.log")

    def __enter__(self) -> Services:
        self._handlers = on_endings(raise_once)
        try:
            self._start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End what was started here: the rig first, since it stops stimulation; the service hears its test's end."""
        on_endings(signal.SIG_IGN)
        self.rig.end(SEAL_S)
        self.api.end()
        if self.emulator is not None:
            self.emulator.end()
        if self._folder_lock is not None:
            os.close(self._folder_lock)
        shutil.rmtree(self.runtime, ignore_errors=True)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _start(self) -> None:
        """Start everything, the devices first, once the data folder is locked.

        Raises LaunchError: another service runs on the data, or a process does not come up.
        """
        data, rig_file = str(self.settings.data_dir.absolute()), self.settings.rig_file
        try:
            self._folder_lock = reserve(self.settings)
        except HeldError as error:
            raise LaunchError(str(error), 2) from error
        for child in filter(None, (self.emulator, self.rig, self.api)):  # all hold it, until the last has ended
            child.inherits = (self._folder_lock,)
        devices = ["--config", str(rig_file)]
        if self.emulator is not None:
            devices = ["--emulator-json", json.dumps(self.emulator.start())]
        self.rig.command += [*devices, "--socket", str(self.socket), "--data", data]
        try:
            self.rig.start()
        except LaunchError as error:
            if error.exit_code != 2 or rig_file is None or str(rig_file) in str(error):
                raise
            raise LaunchError(f"{rig_file}: {error}", 2) from error
        self.api.environment |= {
            INHERITED: str(self._folder_lock),
            "STIMRIG_DATA_DIR": data,
            "STIMRIG_RIG_SOCKET": str(self.socket),
            "STIMRIG_HOST": self.settings.host,
            "STIMRIG_PORT": str(self.settings.port),
            **({} if self.admin_token is None else {"STIMRIG_ADMIN_TOKEN": self.admin_token}),
        }
        self.url = str(self.api.start()["url"])
        self.api.environment["STIMRIG_PORT"] = str(self.api.ready["port"])  # the same one after a restart

    def watch(self) -> list[str]:
        """Start again what died; return what happened, in words.

        Raises LaunchError: the emulator ended, or a process does not stay up.
        """
        if self.emulator is not None and not self.emulator.alive():
            raise self.emulator.failure()
        return [child.restart() for child in (self.rig, self.api) if not child.alive()]
