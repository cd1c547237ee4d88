"""A PostgreSQL cluster of the tests' own: from Debian's package, on a free port, gone when they end."""

from __future__ import annotations

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

STARTS_S = 60.0
TEMPLATE = "stimrig_template"
QUICK = ("fsync=off", "full_page_writes=off", "max_connections=200", "shared_buffers=32MB", "log_min_messages=fatal")
"""A cluster that is thrown away need not survive a crash of the machine."""


def programs() -> Path | None:
    """The folder of the newest PostgreSQL of Debian; None where it is not installed."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"), key=lambda path: int(path.parts[-3]))
    return found[-1].parent if found else None


class Cluster:
    """A running cluster.

    Parameters
    ----------
    folder : Path
        Where it lies; its owner is the one who runs it: PostgreSQL refuses to be root.
    """

    def __init__(self, folder: Path) -> None:
        place = programs()
        assert place is not None, "apt-get install postgresql"
        self.folder, self.place = folder, place
        self.user = "postgres" if os.getuid() == 0 else None
        self.port = free_port()
        self.process: subprocess.Popen[bytes] | None = None
        if self.user is not None:
            shutil.chown(folder, self.user)
        self._run(
            "initdb", "-D", str(folder / "data"), "-U", "stimrig", "-A", "trust", "-E", "UTF8", "--locale=C.UTF-8"
        )

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self.place / program), *arguments]
        done = subprocess.run(command, user=self.user, cwd=self.folder, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr

    def start(self) -> None:
        """Start it and wait until it answers."""
        more = [word for setting in QUICK for word in ("-c", setting)]
        self.process = subprocess.Popen(
            [str(self.place / "postgres"), "-D", str(self.folder / "data"), "-p", str(self.port), "-h", "127.0.0.1",
             "-k", str(self.folder), *more],
            user=self.user, cwd=self.folder, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        end = time.monotonic() + STARTS_S
        while True:
            try:
                psycopg.connect(self.address("postgres")).close()
                return
            except psycopg.OperationalError:
                assert time.monotonic() < end and self.process.poll() is None, "the cluster does not start"
                time.sleep(0.05)

    def address(self, database: str) -> str:
        """The URL of a database."""
        return f"postgresql://stimrig@127.0.0.1:{self.port}/{database}"

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

    def empty(self, name: str) -> str:
        """The URL of a new database without a table."""
        with psycopg.connect(self.address("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return self.address(name)

    def freeze(self) -> None:
        """All its processes stand still, as on a machine that is gone."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """They go on."""
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        """To every process of it: each backend leads a session of its own."""
        assert self.process is not None
        listed = subprocess.run(["ps", "-e", "-o", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
        for line in listed.splitlines():
            pid, parent = map(int, line.split())
            if self.process.pid in (pid, parent):
                os.kill(pid, number)

    def restart(self) -> None:
        """As after a crash of it: all connections are cut."""
        self.stop()
        self.start()

    def stop(self) -> None:
        """End it at once."""
        if self.process is not None:
            self._run("pg_ctl", "-D", str(self.folder / "data"), "-m", "immediate", "stop")
            self.process.wait(60)


def free_port() -> int:
    """A port on which nobody listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def running() -> Iterator[Cluster]:
    """A new cluster, started; it is gone at the end."""
    folder = Path(tempfile.mkdtemp(prefix="stimrig-pg-"))
    folder.chmod(0o711)
    cluster = Cluster(folder)
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()
        shutil.rmtree(folder, ignore_errors=True)
