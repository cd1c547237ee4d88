"""One service on a data folder and a database; the second is told who holds it. What it writes is its owner's alone."""

from __future__ import annotations

import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.cli import main
from stimrig.api.cli.errors import LaunchError
from stimrig.api.cli.supervisor import Child, Services
from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store import Store
from stimrig.api.store.service_lock import HOLDER, INHERITED, HeldError, ServiceLock, reserve
from stimrig.api.store.tables import Participant
from tests.api.conftest import PATIENCE_S, TOKEN
from tests.harness.looks_first import LooksFirst

ROOT = Path(__file__).parents[2]


def test_a_change_waits_for_another_process_that_writes(tmp_path: Path):
    """Also one that reads first: in WAL mode such a transaction fails at once, unless it begins as one that writes."""
    store = Store(f"sqlite:///{tmp_path / 'x.db'}")

    def change() -> None:
        with store.write() as session:
            assert session.get(Participant, "P1") is None
            session.add(Participant(code="P1", created_utc=Clock().utc(), created_by="Ada"))

    with closing(sqlite3.connect(tmp_path / "x.db", isolation_level=None)) as other, ThreadPoolExecutor(1) as pool:
        other.execute("BEGIN IMMEDIATE")
        changed = pool.submit(change)
        try:
            with pytest.raises(TimeoutError):
                changed.result(0.3)
        finally:
            other.execute("COMMIT")
        changed.result(PATIENCE_S)
    assert store.get(Participant, "P1") is not None


def test_a_service_whose_folder_was_replaced_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ended: list[int] = []
    monkeypatch.setattr(os, "kill", lambda _pid, number: ended.append(number))
    lock = ServiceLock(Settings(data_dir=tmp_path / "var"))
    lock.renew()
    assert not ended
    (tmp_path / "var").rename(tmp_path / "old")
    (tmp_path / "var").mkdir()
    lock.renew()
    assert ended == [signal.SIGTERM]
    lock.release()


def command(data: Path, **more: str) -> dict[str, Any]:
    given = {"DATA_DIR": str(data), "PORT": "0", "ADMIN_TOKEN": TOKEN, "WORKERS": "1", **more}
    environment = {**os.environ, **{f"STIMRIG_{name}": value for name, value in given.items()}}
    return {"args": [sys.executable, "-m", "tests.api.served"], "env": environment, "cwd": ROOT, "text": True}


@contextmanager
def served(data: Path, **more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A service as a process that was started with an open mask; it and its address."""
    process = subprocess.Popen(**command(data, **more), umask=0, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        assert process.stdout is not None
        yield process, json.loads(process.stdout.readline())["url"]
    finally:
        process.kill()
        process.wait(20)


@pytest.mark.slow
def test_a_second_service_is_told_who_holds_the_data_and_a_kill_lets_go(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with served(data) as (first, url):
        done = subprocess.run(**command(data), capture_output=True, timeout=60)
        (line,) = [line for line in done.stderr.splitlines() if not line.startswith("{")]
        assert done.returncode == 2 and done.stdout == ""
        assert f"process {first.pid} on {socket.gethostname()}, since 20" in line and f"at {url}; stop it" in line
        assert main.run(["audit", "verify", "--data", str(data)]) == 0, "who only reads is let in"
        http = httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=PATIENCE_S)
        assert http.post("/v1/participants", json={"code": "P1"}).status_code == 201, "the first works on"
        sent = http.post("/v1/participants/P1/recordings", content=b"time_s,pulse_width_us,torque_nm,segment\n")
        files = [path for path in data.rglob("*") if path.is_file()]
        assert sent.status_code in (201, 422) and files
        assert [path for path in files if mode(path) & 0o077] == [], "by the process's own mask, uploads and logs too"
        assert {"stimrig.db", "stimrig.db-wal", "service.lock"} <= {path.name for path in files}
        assert mode(data / "exports") == 0o700 and not mode(data / "recordings") & 0o007
        first.send_signal(signal.SIGKILL)
        first.wait(20)
    held(data_dir=data).release()
    with closing(Store(f"sqlite:///{data}/stimrig.db")) as store:
        assert store.get(Participant, "P1") is not None


def held(**given: Any) -> ServiceLock:
    return ServiceLock(Settings(**given))


@contextmanager
def closing_lock(**given: Any) -> Iterator[ServiceLock]:
    lock = held(**given)
    yield lock
    lock.release()


WAYS: list[dict[str, Any]] = [
    {"data_dir": "one"}, {"data_dir": "link"}, {"data_dir": "two/../one"}, {"data_dir": "one", "database_url": "sqlite://"},
    {"data_dir": "two", "database_url": "sqlite:///PLACE/one/stimrig.db"},
    {"data_dir": "two", "database_url": "sqlite:///PLACE/link/stimrig.db"},
    {"data_dir": "two", "database_url": "sqlite:///PLACE/link.db"},
    {"data_dir": "two", "database_url": "sqlite:///file:PLACE/link.db?uri=true"},
]  # fmt: skip


@pytest.mark.parametrize("way", WAYS, ids=lambda way: " ".join(way.values()))
def test_whichever_way_leads_to_it_it_is_held_once(tmp_path: Path, way: dict[str, Any]) -> None:
    (tmp_path / "two").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "one")
    (tmp_path / "link.db").symlink_to(tmp_path / "one/stimrig.db")
    given = {"data_dir": tmp_path / way["data_dir"]}
    if "database_url" in way:
        given["database_url"] = way["database_url"].replace("PLACE", str(tmp_path))
    with closing_lock(data_dir=tmp_path / "one") as first:
        first.write_holder("http://127.0.0.1:1234")
        with pytest.raises(HeldError, match=f"process {os.getpid()} on .* at http://127.0.0.1:1234; stop it"):
            held(**given)
        held(data_dir=tmp_path / "two").release()
    with closing_lock(**given), pytest.raises(HeldError) as caught:
        held(**given)
    assert "1234" not in str(caught.value), "the message names nobody who is gone"


def test_a_removed_lock_file_lets_nobody_in(tmp_path: Path) -> None:
    with closing_lock(data_dir=tmp_path):
        (tmp_path / HOLDER).unlink()
        for refused in (held, lambda **given: reserve(Settings(**given))):
            with pytest.raises(HeldError, match=f"{tmp_path}: another service runs on it"):
                refused(data_dir=tmp_path)
        services = Services(Settings(data_dir=tmp_path, port=0))
        with pytest.raises(LaunchError, match="another service runs on it") as caught, services:
            pass
        assert caught.value.exit_code == 2 and services.emulator is not None and services.emulator.process is None


def test_what_cannot_be_held_is_refused(tmp_path: Path) -> None:
    Store(f"sqlite:///{tmp_path}/stimrig.db").close()
    os.link(tmp_path / "stimrig.db", tmp_path / "again.db")
    with pytest.raises(HeldError, match="2 names"):
        held(data_dir=tmp_path)
    with pytest.raises(HeldError, match=r"127\.0\.0\.1:1/stimrig: .*STIMRIG_DATABASE_URL") as caught:
        held(data_dir=tmp_path / "b", database_url="postgresql://ann:secret@127.0.0.1:1/stimrig")
    assert "secret" not in str(caught.value) and "\n" not in str(caught.value)
    (tmp_path / "c" / HOLDER).mkdir(parents=True)
    with pytest.raises(HeldError, match="this user may write"):
        held(data_dir=tmp_path / "c")


def test_each_process_of_serve_is_started_under_the_lock_and_the_service_takes_it_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[str] = []

    def start(child: Child) -> dict[str, Any]:
        with pytest.raises(HeldError, match="another service runs on it"):
            held(data_dir=tmp_path)
        begun.append(child.name)
        if child.name == "api":
            monkeypatch.setenv(INHERITED, str(os.dup(child.inherits[0])))
            held(data_dir=tmp_path).release()
            monkeypatch.delenv(INHERITED)
        return child.ready

    monkeypatch.setattr(Child, "start", start)
    services = Services(Settings(data_dir=tmp_path, port=0))
    services.api.ready = {"port": 1, "url": ""}
    with services:
        assert begun == ["emulator", "rig", "api"]
        with pytest.raises(HeldError):
            held(data_dir=tmp_path)
    held(data_dir=tmp_path).release()


def test_a_service_that_does_not_come_up_lets_go(tmp_path: Path) -> None:
    from stimrig.api.errors import ApiError
    from stimrig.api.services.context import build

    (tmp_path / "stimrig.db").write_bytes(b"not a database at all" * 100)
    with pytest.raises(ApiError, match=r"cannot be opened.*restore the database from a backup"):
        build(Settings(data_dir=tmp_path))
    held(data_dir=tmp_path).release()


# ---- for its owner only -------------------------------------------------------------------------------------


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_a_database_that_was_open_to_others_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "stimrig.db"
    with sqlite3.connect(path) as database:  # as an older version left it after a kill
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("CREATE TABLE t (x)")
        database.commit()
        for name in ("stimrig.db", "stimrig.db-wal", "stimrig.db-shm"):
            (tmp_path / name).chmod(0o664)
        Store(f"sqlite:///{path}").close()
        assert {mode(found) for found in tmp_path.glob("stimrig.db*")} == {0o600}
    assert mode(tmp_path / "stimrig.db") == 0o600


def test_new_folders_are_closed_and_shared_ones_stay_as_they_are(tmp_path: Path) -> None:
    held(data_dir=tmp_path / "new").release()
    assert mode(tmp_path / "new") == 0o700
    shared = tmp_path / "shared"
    shared.mkdir(mode=0o770)
    shared.chmod(0o770)
    held(data_dir=shared).release()
    assert mode(shared) == 0o770
