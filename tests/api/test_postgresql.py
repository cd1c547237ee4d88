"""The service on PostgreSQL: the lock of its database, and tests of other files run again with their data there."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
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
import pytest
from sqlalchemy import inspect

from stimrig.api.errors import ApiError
from stimrig.api.settings import Settings
from stimrig.api.store import Store
from stimrig.api.store.service_lock import HeldError, ServiceLock
from tests.api.conftest import STUB, serving, soon, wait_done
from tests.api.test_idle_lock import test_a_lock_holds_over_a_restart as test_a_lock_holds_over_a_restart
from tests.api.test_locking import (
    test_who_decides_again_sends_the_version_of_the_answer as test_who_decides_again_sends_the_version_of_the_answer,
)
from tests.api.test_people import clinician as clinician
from tests.api.test_people import (
    test_changed_password_and_removal_end_sessions as test_changed_password_and_removal_end_sessions,
)
from tests.api.test_people import (
    test_wrong_revoked_and_expired_tokens_are_refused as test_wrong_revoked_and_expired_tokens_are_refused,
)
from tests.api.test_session import test_whole_path_to_the_controller as test_whole_path_to_the_controller
from tests.api.test_tracked import test_a_restart_goes_on_where_it_was as test_a_restart_goes_on_where_it_was
from tests.harness.processes import below

pytestmark = [pytest.mark.postgresql, pytest.mark.slow]

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


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    place = programs()
    if place is None:
        pytest.skip("PostgreSQL is not installed: as root, apt-get install postgresql")
    with running(place) as cluster:
        yield cluster


@pytest.fixture(scope="module", autouse=True)
def data_in_postgresql(cluster: Cluster) -> Iterator[None]:
    """Each data folder has a database of its own in the cluster."""

    def database(settings: Settings) -> str:
        return settings.database_url or cluster.database(str(settings.data_dir.absolute()))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Settings, "database", property(database))
        yield


def lock(cluster: Cluster, folder: Path) -> ServiceLock:
    return ServiceLock(Settings(data_dir=folder, database_url=cluster.database("locked")))


def test_a_second_service_is_refused_until_the_first_has_ended(cluster: Cluster, tmp_path: Path) -> None:
    first = lock(cluster, tmp_path / "a")
    with pytest.raises(HeldError, match="another service runs on it; stop it") as caught:
        lock(cluster, tmp_path / "b")
    assert "\n" not in str(caught.value)
    cluster.restart()
    first.renew()
    with pytest.raises(HeldError, match="another service runs on it"):
        lock(cluster, tmp_path / "b")
    first.release()
    lock(cluster, tmp_path / "b").release()


def test_a_service_whose_lock_another_one_took_ends(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "kill", lambda *given: killed.append(given))
    first = lock(cluster, tmp_path / "a")
    store = Store(cluster.database("locked"))
    with store.engine.connect() as connection:  # as a network that is cut
        connection.exec_driver_sql("SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory'")
    second = lock(cluster, tmp_path / "b")
    first.renew()
    assert killed == [(os.getpid(), signal.SIGTERM)]
    second.renew()
    assert len(killed) == 1
    for one in (first, second, store):
        one.close() if isinstance(one, Store) else one.release()


def test_no_column_limits_the_length_of_a_text(cluster: Cluster) -> None:
    """SQLite does not either: what fits into the one fits into the other."""
    store = Store(cluster.database("columns"))
    inspected = inspect(store.engine)
    limited = [
        (table, column["name"])
        for table in inspected.get_table_names()
        for column in inspected.get_columns(table)
        if getattr(column["type"], "length", None) and table != "alembic_version"
    ]
    store.close()
    assert limited == []


def test_a_database_that_is_not_there_is_refused_in_one_line() -> None:
    with pytest.raises(ApiError) as caught:
        Store("postgresql://ann:secret@127.0.0.1:1/stimrig")
    line = str(caught.value)
    assert "127.0.0.1" in line and "secret" not in line and "\n" not in line and "STIMRIG_DATABASE_URL" in line
    with pytest.raises(ApiError, match="neither sqlite nor postgresql"):
        Store("mysql://ann@127.0.0.1/stimrig")


def test_a_stop_is_answered_while_the_database_is_frozen(cluster: Cluster, tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, STUB, speed=2.0) as (service, client):
        client.post("/v1/participants", json={"code": "P1"})
        test_id = client.post("/v1/tests", json={"participant": "P1"}).json()["id"]
        with cluster.frozen():
            answer = client.post("/v1/stop", json={"reason": "frozen"})
            assert answer.status_code == 200, answer.text
            assert service.rig.status().state != "playing"
        assert wait_done(client, test_id)["state"] in ("stopped", "aborted", "fault")
        cluster.restart()
        assert soon(lambda: client.get("/v1/audit").status_code == 200)
        assert client.get("/v1/audit").json()["whole"]
        assert soon(lambda: "frozen" in json.dumps(client.get("/v1/audit").json()))
