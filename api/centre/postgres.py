"""A PostgreSQL of one's own, from Debian's package, in a folder: for a centre to try out. Never run by root."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import secrets
import shutil
import signal
import subprocess
import time
from pathlib import Path

from stimrig.api import owner_only
from stimrig.api.errors import SettingsError

PROGRAMS = Path("/usr/lib/postgresql")
UNPRIVILEGED = "postgres"
"""Debian's user, for who is root: PostgreSQL refuses to be."""
USER, DATABASE = "stimrig", "centre"
LOCAL = ("listen_addresses=127.0.0.1", "unix_socket_directories=")
STARTS_S, ENDS_S = 60.0, 30.0


def programs() -> Path:
    """The folder of the newest PostgreSQL that is installed. Raises SettingsError, also where its driver is missing."""
    if importlib.util.find_spec("psycopg") is None:
        raise SettingsError("the centre needs more packages: pip install 'stimrig[centre]'")
    found = sorted(PROGRAMS.glob("*/bin/postgres"), key=lambda path: path.parts[-3].zfill(4))
    if not found:
        raise SettingsError("PostgreSQL is not installed: as root, apt-get install postgresql")
    return found[-1].parent


class Cluster:
    """A cluster in a folder, made at its first start.

    `folder`: where it lies; `port`: where it listens, on 127.0.0.1 only.
    """

    SETTINGS: tuple[str, ...] = ()
    """More of PostgreSQL's own."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.port, self.place = folder.absolute(), port, programs()
        self.user = UNPRIVILEGED if os.getuid() == 0 else None
        self.process: subprocess.Popen[bytes] | None = None
        self._secret = self.folder.parent / "postgres.password"

    @property
    def url(self) -> str:
        return self.address(DATABASE).replace("postgresql:", "postgresql+psycopg:")

    def address(self, database: str) -> str:
        """The URL of a database, as PostgreSQL's own programs take it."""
        return f"postgresql://{USER}:{self._secret.read_text('utf-8')}@127.0.0.1:{self.port}/{database}"

    def start(self) -> None:
        """Make it where it is not there yet; start it and wait until it answers. Raises SettingsError."""
        if not (self.folder / "data" / "PG_VERSION").exists():
            self._make()
        log = (self.folder.parent / "postgres.log").open("ab")
        with log:
            self.process = subprocess.Popen(
                [str(self.place / "postgres"), "-D", str(self.folder / "data"), "-p", str(self.port),
                 *(word for one in (*LOCAL, *self.SETTINGS) for word in ("-c", one))],
                user=self.user, cwd="/", stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                preexec_fn=_end_with_parent,
            )  # fmt: skip
        self._wait()

    def _make(self) -> None:
        owner_only.folder(self.folder)
        (self.folder / "data").mkdir(mode=0o700, exist_ok=True)
        self._secret.unlink(missing_ok=True)
        owner_only.file(self._secret)
        self._secret.write_text(secrets.token_urlsafe(24), "utf-8")
        if self.user is not None:
            for path in (self.folder, self.folder / "data"):
                shutil.chown(path, self.user, self.user)
            self._refuse_hidden()
        given = self.folder / "password"
        shutil.copy(self._secret, given)
        if self.user is not None:
            shutil.chown(given, self.user)
        command = [str(self.place / "initdb"), "-D", str(self.folder / "data"), "-U", USER, "-A", "scram-sha-256",
                   f"--pwfile={given}", "-E", "UTF8", "--locale=C.UTF-8"]  # fmt: skip
        done = subprocess.run(command, user=self.user, cwd="/", capture_output=True, text=True, timeout=300)
        given.unlink()
        if done.returncode:
            shutil.rmtree(self.folder / "data", ignore_errors=True)
            raise SettingsError(
                f"{self.folder}: PostgreSQL cannot be set up: {(done.stderr.split(chr(10)) or [''])[0]}"
            )

    def _refuse_hidden(self) -> None:
        """Say it in one line where PostgreSQL's user cannot reach the folder."""
        seen = subprocess.run(["test", "-w", str(self.folder)], user=self.user, cwd="/")
        if seen.returncode:
            fix = "take one like --data /var/tmp/centre-demo"
            raise SettingsError(f"{self.folder}: PostgreSQL's user {self.user} cannot reach it; {fix}")

    def _wait(self) -> None:
        import psycopg

        assert self.process is not None
        end = time.monotonic() + STARTS_S
        while True:
            try:
                with psycopg.connect(self.address("postgres"), autocommit=True) as connection:
                    known = connection.execute("SELECT 1 FROM pg_database WHERE datname = %s", (DATABASE,)).fetchone()
                    if known is None:
                        connection.execute(f"CREATE DATABASE {DATABASE}")
                return
            except psycopg.OperationalError as error:
                if self.process.poll() is not None or time.monotonic() > end:
                    self.stop()
                    log = self.folder.parent / "postgres.log"
                    raise SettingsError(f"{self.folder}: PostgreSQL does not start (log: {log})") from error
                time.sleep(0.1)

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """End it, what is written kept; by a fast shutdown, or another signal."""
        if self.process is None:
            return
        if self.process.poll() is None:
            self.process.send_signal(how)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(ENDS_S)
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _end_with_parent() -> None:
    """In the child, before it becomes PostgreSQL: end when the one who started it does."""
    ctypes.CDLL(None).prctl(1, signal.SIGINT)
