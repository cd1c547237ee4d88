"""The service on PostgreSQL: the lock of its database, and tests of other files run again with their data there."""

from __future__ import annotations

import hashlib
import json
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
import pytest

from stimrig.api.errors import ApiError
from stimrig.api.settings import Settings
from stimrig.api.store import Store
from stimrig.api.store.service_lock import HeldError, ServiceLock
from tests.api.conftest import STUB, serving, soon, wait_done
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

UNPRIVILEGED = "postgres" if os.getuid() == 0 else None
"""Debian's user, for root: PostgreSQL refuses to run as root."""
OPTIONS = (
    "-c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off -c full_page_writes=off "
    "-c max_connections=200 -c shared_buffers=32MB -c log_min_messages=fatal"
)


class Cluster:
    """A cluster in a folder that PostgreSQL's user may enter; it need not survive a crash of the machine."""

    def __init__(self, folder: Path, place: Path) -> None:
        self.folder, self.place = folder, place
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        folder.mkdir(mode=0o700)
        if UNPRIVILEGED is not None:
            shutil.chown(folder, UNPRIVILEGED, UNPRIVILEGED)
        self.run("initdb", "-U", "stimrig", "-A", "trust", "-E", "UTF8", "--locale=C.UTF-8", "--no-sync")
        self.control("start")

    def run(self, program: str, *words: str) -> None:
        subprocess.run(
            [self.place / program, "-D", self.folder, *words], user=UNPRIVILEGED, cwd="/", check=True, timeout=300,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def control(self, action: str) -> None:
        """`start`, `stop` or `restart`, as after a crash of it: all connections are cut."""
        how = [] if action == "start" else ["-m", "immediate"]
        self.run("pg_ctl", "-w", "-t", "60", "-o", f"-p {self.port} {OPTIONS}", *how, action)

    def address(self, database: str) -> str:
        """The URL of a database, as PostgreSQL's own programs take it."""
        return f"postgresql://stimrig@127.0.0.1:{self.port}/{database}"

    def database(self, name: str) -> str:
        """The URL of a database of this name, made with the tables of today where it is not there yet."""
        name = "t" + hashlib.sha256(name.encode()).hexdigest()[:20]
        with psycopg.connect(self.address("postgres"), autocommit=True) as connection:
            known = {row[0] for row in connection.execute("SELECT datname FROM pg_database")}
            if "template" not in known:
                connection.execute("CREATE DATABASE template")
                Store(self.address("template")).close()
            if name not in known:
                connection.execute(f"CREATE DATABASE {name} TEMPLATE template")
        return self.address(name)

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """All its processes stand still, as on a machine that is gone; each backend leads a session of its own."""
        first = int((self.folder / "postmaster.pid").read_text().splitlines()[0])
        pids = [first, *below(first)]
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in pids:
                os.kill(pid, signal.SIGCONT)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: path.parts[-2].zfill(4))
    if not installed:
        pytest.skip("PostgreSQL is not installed: as root, apt-get install postgresql")
    with tempfile.TemporaryDirectory(prefix="stimrig-pg-", ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o711)
        cluster = Cluster(Path(folder) / "cluster", installed[-1])
        yield cluster
        cluster.control("stop")


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
    cluster.control("restart")
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
            assert service.rig.stopped_by is not None
        assert wait_done(client, test_id)["state"] in ("stopped", "aborted", "fault")
        cluster.control("restart")
        assert soon(lambda: client.get("/v1/audit").status_code == 200)
        assert client.get("/v1/audit").json()["whole"]
        assert soon(lambda: "frozen" in json.dumps(client.get("/v1/audit").json()))
