"""A PostgreSQL cluster of the tests' own: from Debian's package, on a free port, gone when they end."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from stimrig.api.store import Store
from tests.harness.processes import below

USER, TEMPLATE = "stimrig", "stimrig_template"
UNPRIVILEGED = "postgres" if os.getuid() == 0 else None
"""Debian's user, for root: PostgreSQL refuses to run as root."""
SETTINGS = (
    "listen_addresses=127.0.0.1", "unix_socket_directories=", "fsync=off", "full_page_writes=off",
    "max_connections=200", "shared_buffers=32MB", "log_min_messages=fatal",
)  # fmt: skip
STARTS_S, ENDS_S = 60.0, 30.0


def programs() -> Path | None:
    """The folder of the newest PostgreSQL that is installed."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"), key=lambda path: path.parts[-3].zfill(4))
    return found[-1].parent if found else None


class Cluster:
    """A cluster in a folder that PostgreSQL's user may enter; it need not survive a crash of the machine."""

    def __init__(self, folder: Path, place: Path) -> None:
        self.folder, self.place = folder, place
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.process: subprocess.Popen[bytes] | None = None
        folder.mkdir(mode=0o700)
        if UNPRIVILEGED is not None:
            shutil.chown(folder, UNPRIVILEGED, UNPRIVILEGED)
        command = [str(place / "initdb"), "-D", str(folder), "-U", USER, "-A", "trust", "-E", "UTF8",
                   "--locale=C.UTF-8", "--no-sync"]  # fmt: skip
        subprocess.run(command, user=UNPRIVILEGED, cwd="/", capture_output=True, check=True, timeout=300)

    def address(self, database: str) -> str:
        """The URL of a database, as PostgreSQL's own programs take it."""
        return f"postgresql://{USER}@127.0.0.1:{self.port}/{database}"

    def start(self) -> None:
        """Start it and wait until it answers."""
        words = [word for one in SETTINGS for word in ("-c", one)]
        self.process = subprocess.Popen(
            [str(self.place / "postgres"), "-D", str(self.folder), "-p", str(self.port), *words],
            user=UNPRIVILEGED, cwd="/", stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True, preexec_fn=_end_with_parent,
        )  # fmt: skip
        end = time.monotonic() + STARTS_S
        while True:
            try:
                psycopg.connect(self.address("postgres")).close()
                return
            except psycopg.OperationalError:
                if self.process.poll() is not None or time.monotonic() > end:
                    raise
                time.sleep(0.1)

    def stop(self) -> None:
        """End it at once."""
        if self.process is None:
            return
        self.process.send_signal(signal.SIGQUIT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(ENDS_S)
        self.process.kill()
        self.process.wait()

    def database(self, name: str) -> str:
        """The URL of a database of this name, made with the tables of today where it is not there yet."""
        name = "t" + hashlib.sha256(name.encode()).hexdigest()[:20]
        with psycopg.connect(self.address("postgres"), autocommit=True) as connection:
            known = {row[0] for row in connection.execute("SELECT datname FROM pg_database")}
            if TEMPLATE not in known:
                connection.execute(f"CREATE DATABASE {TEMPLATE}")
                Store(self.address(TEMPLATE)).close()
            if name not in known:
                connection.execute(f"CREATE DATABASE {name} TEMPLATE {TEMPLATE}")
        return self.address(name)

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """All its processes stand still, as on a machine that is gone; each backend leads a session of its own."""
        assert self.process is not None
        pids = [self.process.pid, *below(self.process.pid)]
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in pids:
                os.kill(pid, signal.SIGCONT)

    def restart(self) -> None:
        """As after a crash of it: all connections are cut."""
        self.stop()
        self.start()


def _end_with_parent() -> None:
    """In the child, before it becomes PostgreSQL: end when the one who started it does."""
    ctypes.CDLL(None).prctl(1, signal.SIGINT)


@contextmanager
def running(place: Path) -> Iterator[Cluster]:
    """A new cluster of the programs in `place`, started; it is gone at the end."""
    with tempfile.TemporaryDirectory(prefix="stimrig-pg-", ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o711)
        cluster = Cluster(Path(folder) / "cluster", place)
        try:
            cluster.start()
            yield cluster
        finally:
            cluster.stop()
