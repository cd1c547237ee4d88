"""Emulator, rig and service as separate processes that live and die together.

The rig is started again when it dies (it comes up uncertain and waits for a person), the service too. From the first
one on, none outlives the launcher, however it ends: SIGTERM and Ctrl-C end them in order, and the kernel ends those
that are left when the launcher is no more.
"""

from __future__ import annotations

import contextlib
import ctypes
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
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from api import owner_only
from api.cli.errors import LaunchError
from api.cli.streams import Streams
from api.settings import Settings
from api.store.lock import HeldError, refuse_if_held

READY_S = 60.0
END_S = 6.0
SEAL_S = 35.0
"""The rig may still have a test to seal."""
RESTART_S = (0.2, 0.5, 1.0, 2.0, 5.0)
OUTBOX_RESTART_S = (1.0, 5.0, 30.0, 300.0)
LAST_BYTES = 100_000
"""So much of a log's end is read for a process's last words."""
STEADY_S = 600.0
"""What ran for so long is started again at once."""
LIBC = ctypes.CDLL(None, use_errno=True)
PR_SET_PDEATHSIG = 1
ENDINGS = (signal.SIGTERM, signal.SIGINT)


class Ended(KeyboardInterrupt):
    """SIGTERM or Ctrl-C: what was started is to end."""


class Endings:
    """Within it SIGTERM and Ctrl-C raise `Ended`, once; further ones do not interrupt the ending."""

    def __init__(self) -> None:
        self.deaf = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Endings:
        if threading.current_thread() is threading.main_thread():  # no other one may set what a signal does
            self._before = {number: signal.signal(number, self._end) for number in ENDINGS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _end(self, _number: int, _frame: object) -> None:
        if not self.deaf:
            self.deaf = True
            raise Ended


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
    _log_start: int = 0

    def start(self) -> dict[str, Any]:
        """Start it and wait for its ready line.

        Raises
        ------
        LaunchError
            It ended instead, or said nothing: its own last line is the message.
        """
        line = read_line(self._launch(subprocess.PIPE), READY_S)
        try:
            self.ready = json.loads(line)
        except ValueError:
            raise self.failure() from None
        return self.ready

    def start_unheard(self) -> None:
        """Start it and wait for nothing; one that cannot be started is found to have ended."""
        with contextlib.suppress(OSError):
            self._launch(subprocess.DEVNULL)

    def _launch(self, stdout: int) -> subprocess.Popen[bytes]:
        self.started_s = time.monotonic()
        with self.log.open("ab") as log:
            self._log_start = log.tell()
            # A signal comes before there is a process, or when it is known: never between.
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
            try:
                self.process = subprocess.Popen(
                    self.command,
                    stdin=subprocess.DEVNULL,
                    stdout=stdout,
                    stderr=log,
                    env={**os.environ, **self.environment},
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

    def ask_to_end(self) -> None:
        """SIGTERM."""
        if self.alive():
            assert self.process is not None
            self.process.terminate()

    def end(self, limit_s: float = END_S) -> None:
        """SIGTERM, and SIGKILL if that was not heard."""
        if self.process is None:
            return
        self.ask_to_end()
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


class Services:
    """The whole rig: with no rig file, the emulator stands in for the hardware.

    Parameters
    ----------
    settings : Settings
        Data folder, host, port, rig file.
    emulator_arguments : list of str
        Passed to the emulator.
    admin_token : str or None
        Set the administrator's token instead of drawing one.
    attach : Path or None
        Socket of a rig that runs already: none is started, and none is ended.
    """

    def __init__(
        self,
        settings: Settings,
        emulator_arguments: list[str] | None = None,
        admin_token: str | None = None,
        attach: Path | None = None,
    ) -> None:
        self.settings, self.attached = settings, attach is not None
        self._endings = Endings()
        owner_only.folder(owner_only.folder(settings.data_dir) / settings.logs_dir.name)
        self.runtime = Path(tempfile.mkdtemp(prefix="stimrig-"))  # a Unix socket's path holds 107 characters only
        self.socket = attach.absolute() if attach else self.runtime / "rig.sock"
        self.emulator: Child | None = None
        if settings.rig_file is None and not self.attached:
            arguments = ["--die-with-parent", *(emulator_arguments or [])]
            self.emulator = self._child("emulator", ["hardware_sim", *arguments])
        self.rig = self._child("rig", ["rig"])
        self.api = self._child("api", ["api.web.server"])
        self.outbox = None if settings.centre_url is None else self._child("outbox", ["api.outbox"])
        self.admin_token = admin_token
        self.lsl = Streams(self._child("lsl", ["rig.lsl_outlets"])) if settings.lsl else None

    def _child(self, name: str, module: list[str]) -> Child:
        return Child(name, [sys.executable, "-m", *module], self.settings.logs_dir / f"{name}.log")

    def __enter__(self) -> Services:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._endings)
            stack.callback(self.stop)
            self.start()
            self._at_the_end = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._at_the_end.close()

    @property
    def emulated(self) -> bool:
        """Whether no person is connected: the emulator was started here, or runs behind the rig that is attached to."""
        return self.emulator is not None or (self.attached and self.settings.emulated)

    @property
    def url(self) -> str:
        """Where the service answers."""
        return str(self.api.ready["url"])

    @property
    def control_line(self) -> str | None:
        """The socket by which faults are made and the arm is moved; None: no emulator was started here."""
        return None if self.emulator is None else self.emulator.ready.get("control")

    @property
    def drawn_token(self) -> str | None:
        """The first administrator's token, if it was drawn at this start."""
        return self.api.ready.get("drawn_token")

    def start(self) -> None:
        """Start everything, the devices first."""
        data = str(self.settings.data_dir.absolute())
        try:
            refuse_if_held(self.settings)
        except HeldError as error:
            raise LaunchError(str(error), 2) from error
        if not self.attached:
            self._start_devices(data)
        self.api.environment = {
            "STIMRIG_DATA_DIR": data,
            "STIMRIG_RIG_SOCKET": str(self.socket),
            "STIMRIG_HOST": self.settings.host,
            "STIMRIG_PORT": str(self.settings.port),
            "STIMRIG_EMULATED": str(self.emulated).lower(),
        }
        if self.admin_token is not None:
            self.api.environment["STIMRIG_ADMIN_TOKEN"] = self.admin_token
        self.api.start()
        self.api.environment["STIMRIG_PORT"] = str(self.api.ready["port"])  # the same one after a restart
        if self.outbox is not None:
            self.outbox.environment = {"STIMRIG_DATA_DIR": data}
            self.outbox.start_unheard()
        if self.lsl is not None:
            self.lsl.start([] if self.attached else self._source(), data)

    def _start_devices(self, data: str) -> None:
        if self.emulator is not None:
            self.emulator.start()
        self.rig.command += [*self._source(), "--socket", str(self.socket), "--data", data]
        self._start_rig()

    def _source(self) -> list[str]:
        """What says which devices there are."""
        if self.emulator is not None:
            return ["--emulator-json", json.dumps(self.emulator.ready)]
        return ["--config", str(self.settings.rig_file)]

    def _start_rig(self) -> None:
        try:
            self.rig.start()
        except LaunchError as error:
            place = str(self.settings.rig_file)
            if error.exit_code == 2 and self.settings.rig_file is not None and place not in str(error):
                raise LaunchError(f"{place}: {error}", 2) from error
            raise

    def watch(self) -> list[str]:
        """Start again what died; what happened, in words.

        Raises
        ------
        LaunchError
            The emulator ended, or a process does not stay up.
        """
        if self.emulator is not None and not self.emulator.alive():
            raise self.emulator.failure()
        ours = (self.api,) if self.attached else (self.rig, self.api)
        events = [self._restart(child) for child in ours if not child.alive()]
        return events + self._keep_telling() + (self.lsl.watch() if self.lsl is not None else [])

    def _keep_telling(self) -> list[str]:
        """Start what tells the centre again where it has ended, at longer and longer intervals; it ends nobody else."""
        child = self.outbox
        if child is None or child.alive():
            return []
        up_s = time.monotonic() - child.started_s
        if up_s < OUTBOX_RESTART_S[min(child.restarts, len(OUTBOX_RESTART_S) - 1)]:
            return []
        words = child.last_words()
        child.end()
        child.restarts = 1 if up_s > STEADY_S else child.restarts + 1
        child.start_unheard()
        return [f"outbox had ended ({words or 'without a message'}) and was started again"]

    def _restart(self, child: Child) -> str:
        if time.monotonic() - child.started_s > 60:
            child.restarts = 0
        if child.restarts >= len(RESTART_S):
            raise child.failure()
        time.sleep(RESTART_S[child.restarts])
        child.restarts += 1
        words = child.last_words()
        child.end()
        child.start()
        return f"{child.name} had ended ({words or 'without a message'}) and was started again"

    def stop(self) -> None:
        """End what was started here: the rig first, since it stops stimulation; the service hears its test's end."""
        self._endings.deaf = True
        self.rig.end(SEAL_S)
        self.api.end()
        if self.outbox is not None:
            self.outbox.end()
        if self.lsl is not None:
            self.lsl.child.end()
        if self.emulator is not None:
            self.emulator.end()
        shutil.rmtree(self.runtime, ignore_errors=True)


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
