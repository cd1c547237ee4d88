"""Several services on one PostgreSQL database: what one of them does counts at all of them at once."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest
from sqlalchemy import inspect

from stimrig.api.errors import ApiError
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit, database, holds
from stimrig.api.store.holds import Among
from stimrig.api.store.tables import AuditEntry, Model, Test
from stimrig.api.web.app import create_app
from tests.api.conftest import PATIENCE_S, STUB, TOKEN, Server, Service, play_test, soon, wait_done
from tests.api.fake_rig import RigThread
from tests.api.test_one_service import served
from tests.harness.postgres import Cluster, running

ROOT = Path(__file__).parents[2]
RIG = "rig-of-the-tests"


def settings(data: Path, address: str, socket: Path | None) -> Settings:
    return Settings(
        data_dir=data, database_url=address, admin_token=TOKEN, rig_socket=socket, rig_name=RIG, port=0, workers=1
    )  # pyright: ignore[reportCallIssue, reportArgumentType]


@contextmanager
def two(tmp_path: Path, short_dir: Path, address: str, speed: float = 30.0) -> Iterator[list[Service]]:
    """Two services with one rig and one database, each with a data folder of its own."""
    socket = short_dir / f"rig-{time.time_ns()}.sock"
    with ExitStack() as stack:
        rig = stack.enter_context(RigThread(socket, tmp_path / "rig", speed=speed))
        yield [one(stack, tmp_path / name, address, rig) for name in ("a", "b")]


def one(stack: ExitStack, data: Path, address: str, rig: RigThread) -> Service:
    """A service on that database with that rig."""
    app = create_app(settings(data, address, rig.path), worker=STUB)
    return Service(stack.enter_context(Server(app)), app, rig, data)


@pytest.fixture
def address(cluster: Cluster, tmp_path: Path) -> str:
    return cluster.database(str(tmp_path))


# ---- what one does counts at the other ----------------------------------------------------------------------


def test_a_rejection_and_a_revoked_token_count_everywhere_at_once(
    tmp_path: Path, short_dir: Path, address: str
) -> None:
    with two(tmp_path, short_dir, address) as (a, b), a.client() as at_a, b.client() as at_b:
        model = play_test(at_a, "P1")["model_id"]
        text = b.token("reader", "read-model")
        with a.client(text) as reader_at_a, b.client(text) as reader_at_b:
            for round_ in range(5):
                one, other = (at_a, at_b) if round_ % 2 else (at_b, at_a)
                assert one.post(f"/v1/models/{model}/approve", json={"reason": "good"}).status_code == 200
                for reader in (reader_at_a, reader_at_b):
                    assert reader.get("/v1/participants/P1/model").json()["model_id"] == model
                assert other.post(f"/v1/models/{model}/reject", json={"reason": "no"}).status_code == 200
                for reader in (reader_at_a, reader_at_b):
                    assert reader.get("/v1/participants/P1/model").status_code == 404
            (row,) = [row for row in at_a.get("/v1/tokens").json() if row["name"] == "reader"]
            assert at_b.delete(f"/v1/tokens/{row['id']}").status_code == 204
            for reader in (reader_at_a, reader_at_b):
                assert reader.get("/v1/participants/P1/model").status_code == 401
        assert at_b.get("/v1/audit").json()["whole"]


def test_a_right_to_stop_of_one_page_is_good_at_the_other(tmp_path: Path, short_dir: Path, address: str) -> None:
    with two(tmp_path, short_dir, address) as (a, b):
        right = a.context.stop_rights.give("Ada", None)
        assert httpx.post(f"{b.url}/v1/stop", headers={"X-Stop-Right": right}, timeout=60).status_code == 200


def test_one_rig_is_held_by_one_test_whoever_asks(tmp_path: Path, short_dir: Path, address: str) -> None:
    with two(tmp_path, short_dir, address) as services, ExitStack() as stack:
        clients = [stack.enter_context(service.client()) for service in services for _ in range(4)]
        for code in ("P1", "P2"):
            clients[0].post("/v1/participants", json={"code": code})

        def begin(number: int) -> httpx.Response:
            return clients[number].post("/v1/tests", json={"participant": f"P{1 + number % 2}"})

        with ThreadPoolExecutor(8) as pool:
            answers = list(pool.map(begin, range(8)))
        (begun,) = [answer.json() for answer in answers if answer.status_code == 202]
        for refused in (answer for answer in answers if answer.status_code != 202):
            assert refused.status_code == 409 and refused.json()["holder"]["test_id"] == begun["id"], refused.text
        for client in (clients[0], clients[-1]):
            assert wait_done(client, begun["id"])["state"] == "completed"
        store = services[0].context.store
        assert len(store.all(Test, Test.state == "completed")) == len(store.all(Model)) == 1
        entries = store.all(AuditEntry, order=AuditEntry.seq)
        assert audit.first_broken(entries) is None


# ---- one that dies ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("when", ["plays", "identifies"])
def test_what_a_killed_service_leaves_is_taken_up_by_the_other(
    tmp_path: Path, short_dir: Path, address: str, when: str
) -> None:
    socket = short_dir / f"rig-{time.time_ns()}.sock"
    more = {"DATABASE_URL": address, "RIG_SOCKET": str(socket), "RIG_NAME": RIG, "WORKERS": "1"}
    with ExitStack() as stack:
        rig = stack.enter_context(RigThread(socket, tmp_path / "rig", speed=30.0 if when == "plays" else 2000.0))
        process, url = stack.enter_context(served(tmp_path / "a", **more))
        b = one(stack, tmp_path / "b", address, rig)
        at_b = stack.enter_context(b.client())
        assert at_b.post("/v1/participants", json={"code": "P1"}).status_code == 201
        header = {"Authorization": f"Bearer {TOKEN}", "If-Match": at_b.get("/v1/participants/P1").headers["etag"]}
        begun = httpx.post(f"{url}/v1/tests", json={"participant": "P1"}, headers=header, timeout=PATIENCE_S)
        test_id = begun.json()["id"]
        state = "running" if when == "plays" else "identifying"
        soon(lambda: at_b.get(f"/v1/tests/{test_id}").json()["state"] in (state, "completed"))
        process.send_signal(signal.SIGKILL)
        process.wait(20)
        told = wait_done(at_b, test_id)
        assert told["state"] == "completed" and told["model_id"], told
        assert len(b.context.store.all(Model)) == 1
        assert at_b.get("/v1/audit").json()["whole"]


def test_what_a_living_service_follows_is_left_to_it(tmp_path: Path, short_dir: Path, address: str) -> None:
    """A second service comes up in the middle of a test of the first one."""
    socket = short_dir / f"rig-{time.time_ns()}.sock"
    with ExitStack() as stack:
        rig = stack.enter_context(RigThread(socket, tmp_path / "rig", speed=12.0))
        a = one(stack, tmp_path / "a", address, rig)
        at_a = stack.enter_context(a.client())
        at_a.post("/v1/participants", json={"code": "P1"})
        test_id = at_a.post("/v1/tests", json={"participant": "P1"}).json()["id"]
        one(stack, tmp_path / "b", address, rig)
        context = a.context
        assert wait_done(at_a, test_id)["state"] == "completed"
        assert context.store.get(Test, test_id).followed_by == context.holds.me


@pytest.mark.slow
def test_a_turn_is_had_by_one_and_given_back_by_the_dead(
    cluster: Cluster, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    taking = (
        "import asyncio, sys\nfrom stimrig.api.store import Store, holds\n"
        "async def main():\n"
        "    async with holds.open_holds(Store(sys.argv[1])).turn('limits'):\n"
        "        print('had', flush=True)\n        await asyncio.sleep(600)\n"
        "asyncio.run(main())\n"
    )
    monkeypatch.setitem(database.SERVER_SETTINGS, "lock_timeout", 1000)  # it is always waited out
    store = Store(address)
    held = holds.open_holds(store)
    assert isinstance(held, holds.Among)
    process = subprocess.Popen([sys.executable, "-c", taking, address], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert process.stdout is not None and process.stdout.readline() == "had\n"
        with store.engine.connect() as connection:
            query = f"SELECT pg_try_advisory_lock({holds.key('turn limits')})"
            assert connection.exec_driver_sql(query).scalar() is False
            with pytest.raises(ApiError, match="Another service has begun what this must wait for"):
                asyncio.run(taken(held))
            process.kill()
            process.wait(20)
            soon(lambda: connection.exec_driver_sql(query).scalar())
    finally:
        process.kill()
        held.close()
        store.close()


# ---- the database -------------------------------------------------------------------------------------------

WRITERS = """
import multiprocessing, sys
from stimrig.api.store import Store, audit

def write(name, together):
    together.wait(120)
    store = Store(sys.argv[1])
    together.wait(120)
    for number in range(40):
        with store.write() as session:
            audit.write(session, "2026-01-01T00:00:00Z", name, "count", "nothing", number=number)
    store.close()

fork = multiprocessing.get_context("fork")
together = fork.Barrier(8)
writers = [fork.Process(target=write, args=(f"writer {number}", together)) for number in range(8)]
for writer in writers:
    writer.start()
for writer in writers:
    writer.join()
sys.exit(any(writer.exitcode for writer in writers))
"""
"""Eight processes; what they need is loaded once, before they part."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["postgresql", "sqlite"])
def test_the_audit_chain_is_whole_under_eight_writers(
    request: pytest.FixtureRequest, tmp_path: Path, kind: str
) -> None:
    """They open it at the same moment, too: one of them makes the tables."""
    if kind == "sqlite":
        address = f"sqlite:///{tmp_path}/stimrig.db"
    else:
        address = request.getfixturevalue("cluster").empty(f"writers_{os.getpid()}")
    done = subprocess.run([sys.executable, "-c", WRITERS, address], cwd=ROOT, timeout=240)
    assert done.returncode == 0
    store = Store(address)
    entries = store.all(AuditEntry, order=AuditEntry.seq)
    assert audit.first_broken(entries) is None
    assert len({(entry.who, entry.detail["number"]) for entry in entries}) == len(entries) == 8 * 40
    store.close()


async def taken(held: holds.Holds) -> None:
    async with held.turn("limits"):
        pass


def test_no_column_holds_a_text_to_a_length(cluster: Cluster, address: str) -> None:
    """SQLite does not either: what fits into the one fits into the other."""
    store = Store(address)
    seen = inspect(store.engine)
    found = [
        (table, column["name"])
        for table in seen.get_table_names()
        for column in seen.get_columns(table)
        if getattr(column["type"], "length", None) and table != "alembic_version"
    ]
    store.close()
    assert found == [], "write sa.String without a length in the revision"


def test_a_database_that_is_not_there_or_newer_is_told_in_one_line(cluster: Cluster) -> None:
    with pytest.raises(ApiError) as caught:
        Store("postgresql://ann:secret@127.0.0.1:1/stimrig")
    line = str(caught.value)
    assert "127.0.0.1" in line and "secret" not in line and "\n" not in line and "STIMRIG_DATABASE_URL" in line
    newer = cluster.empty(f"newer_{os.getpid()}")
    store = Store(newer)
    with store.write() as session:
        session.connection().exec_driver_sql("UPDATE alembic_version SET version_num = '0900'")
    store.close()
    with pytest.raises(ApiError, match="it is of version 0900"):
        Store(newer)
    with pytest.raises(ApiError, match="neither sqlite nor postgresql"):
        Store("mysql://ann@127.0.0.1/stimrig")


@pytest.mark.slow
def test_a_stop_is_answered_while_the_database_is_frozen_and_all_goes_on_after_it(
    tmp_path: Path, short_dir: Path
) -> None:
    """A cluster of its own: it is stopped in the middle, and started anew."""
    with ExitStack() as stack:
        cluster = stack.enter_context(running())
        a, b = stack.enter_context(two(tmp_path, short_dir, cluster.database("frozen"), speed=2.0))
        at_a, at_b = stack.enter_context(a.client()), stack.enter_context(b.client())
        at_a.post("/v1/participants", json={"code": "P1"})
        at_b.get("/v1/participants")
        test_id = at_a.post("/v1/tests", json={"participant": "P1"}).json()["id"]
        cluster.freeze()
        try:
            told = at_b.post("/v1/stop", json={"reason": "frozen"})
            assert told.status_code == 200, told.text
            assert a.rig.status().state != "playing"
        finally:
            cluster.thaw()
        assert wait_done(at_a, test_id)["state"] in ("stopped", "aborted", "fault")
        cluster.restart()
        assert soon(lambda: at_b.get("/v1/audit").status_code == 200)
        assert at_b.get("/v1/audit").json()["whole"]
        assert soon(lambda: "frozen" in json.dumps(at_b.get("/v1/audit").json()))


def test_a_turn_that_is_given_up_is_let_go(cluster: Cluster, address: str) -> None:
    del cluster
    stores = [Store(address) for _ in range(2)]
    one, other = (Among(store.engine) for store in stores)

    async def wants() -> None:
        async with one.turn("rig"):
            pytest.fail("it was given up")

    async def both() -> None:
        async with other.turn("rig"):
            waiting = asyncio.create_task(wants())
            await asyncio.sleep(0.3)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
        await asyncio.sleep(0.3)  # it comes to who no longer wants it
        async with other.turn("rig"):
            pass

    asyncio.run(both())
    for held, store in zip((one, other), stores, strict=True):
        held.close()
        store.close()
