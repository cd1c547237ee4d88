"""A PostgreSQL cluster of the tests' own: from Debian's package, on a free port, gone when they end."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from stimrig.api.centre import postgres
from stimrig.api.store import Store

TEMPLATE = "stimrig_template"
QUICK = ("fsync=off", "full_page_writes=off", "max_connections=200", "shared_buffers=32MB", "log_min_messages=fatal")


class Cluster(postgres.Cluster):
    """A cluster that is thrown away: it need not survive a crash of the machine."""

    SETTINGS = QUICK

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
        self.stop(signal.SIGQUIT)
        self.start()


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
    cluster = Cluster(folder / "cluster", free_port())
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop(signal.SIGQUIT)
        shutil.rmtree(folder, ignore_errors=True)
