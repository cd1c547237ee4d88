"""Emulator, rig and service as separate processes that live and die together.

The rig is started again when it dies (it comes up uncertain and waits for a person), the service too. From the first
one on, none outlives the launcher, however it ends: SIGTERM and Ctrl-C end them in order, and the kernel ends those
that are left when the launcher is no more.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from stimrig.api import owner_only
from stimrig.api.cli.child import ENDINGS, Child
from stimrig.api.cli.errors import LaunchError
from stimrig.api.settings import Settings
from stimrig.api.store.service_lock import INHERITED, HeldError, reserve

SEAL_S = 35.0
"""The rig may still have a test to seal."""
RESTART_S = (0.2, 0.5, 1.0, 2.0, 5.0)


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


class Services:
    """The whole rig: with no rig file, the emulator stands in for the hardware.

    `admin_token`: set the administrator's token instead of drawing one. `attach`: socket of a rig that runs already:
    none is started, and none is ended.
    """

    def __init__(
        self,
        settings: Settings,
        emulator_arguments: list[str] | None = None,
        admin_token: str | None = None,
        attach: Path | None = None,
    ) -> None:
        self.settings, self.attached = settings, attach is not None
        self._folder_lock: int | None = None
        self._endings = Endings()
        owner_only.folder(owner_only.folder(settings.data_dir) / settings.logs_dir.name)
        self.runtime = Path(tempfile.mkdtemp(prefix="stimrig-"))  # a Unix socket's path holds 107 characters only
        self.socket = attach.absolute() if attach else self.runtime / "rig.sock"
        self.emulator: Child | None = None
        if settings.rig_file is None and not self.attached:
            arguments = ["--die-with-parent", *(emulator_arguments or [])]
            self.emulator = self._child("emulator", ["stimrig.hardware_sim", *arguments])
        self.rig = self._child("rig", ["stimrig.rig"])
        self.api = self._child("api", ["stimrig.api.web"])
        self.admin_token = admin_token

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
            self._folder_lock = reserve(self.settings)
        except HeldError as error:
            raise LaunchError(str(error), 2) from error
        if self._folder_lock is not None:  # all that is started holds it, until the last of them has ended
            for child in filter(None, (self.emulator, self.rig, self.api)):
                child.inherits = (self._folder_lock,)
        if self.emulator is not None:
            self.emulator.start()
        if not self.attached:
            self.rig.command += [*self._source(), "--socket", str(self.socket), "--data", data]
            self._start_rig()
        self.api.environment = {
            INHERITED: "" if self._folder_lock is None else str(self._folder_lock),
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

        Raises LaunchError: the emulator ended, or a process does not stay up.
        """
        if self.emulator is not None and not self.emulator.alive():
            raise self.emulator.failure()
        ours = (self.api,) if self.attached else (self.rig, self.api)
        return [self._restart(child) for child in ours if not child.alive()]

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
        if self.emulator is not None:
            self.emulator.end()
        if self._folder_lock is not None:
            os.close(self._folder_lock)
            self._folder_lock = None
        shutil.rmtree(self.runtime, ignore_errors=True)
