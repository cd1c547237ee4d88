"""A service on a real port, with a fake rig behind it."""

from __future__ import annotations

import asyncio
import shutil
import ssl
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing.forkserver import set_forkserver_preload
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from argon2 import PasswordHasher
from sqlalchemy import text
from websockets.sync.client import ClientConnection, connect

from stimrig.api.cli import main
from stimrig.api.clock import Clock
from stimrig.api.jobs import process, worker
from stimrig.api.people import accounts
from stimrig.api.settings import Settings
from stimrig.api.store import Store, database
from stimrig.api.web.app import create_app
from stimrig.api.web.server import configuration
from tests.api import thread_worker
from tests.api.fake_rig import FakeRig, RigThread
from tests.harness.looks_first import LooksFirst

TOKEN = "administrator-token-of-the-tests"
HTML = {"Accept": "text/html,application/xhtml+xml"}
STUB, REAL = thread_worker.STUB, thread_worker.REAL
"""Workers as threads: one that fits nothing, and one that does what a worker does."""
PATIENCE_S = 60.0
"""For each answer: a busy machine is slow, and a test says so where an answer has to be quick."""
QUICK_SPEED = 600.0
"""Times the world's: a whole test is played within a frame or two."""
NO_TLS = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
"""Services of tests speak plain HTTP: without it every client would read the machine's certificates, 20 ms each."""
DURABLE = database._durable_sqlite


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as `slow` what starts a service: thousands of them take minutes."""
    for item in items:
        if {"short_dir", "service"} & set(getattr(item, "fixturenames", ())):
            item.add_marker("slow")
            item.add_marker("service")


LOOPS: list[Any] = [None]
"""The loop of a browser's driver: it stands in the main thread for the whole run, as if it always ran there."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """The driver's loop is hidden from tests without a browser: they have loops of their own in this thread."""
    shown = LOOPS[-1] if "browser" in getattr(item, "fixturenames", ()) else None
    asyncio._set_running_loop(shown)
    try:
        return (yield)
    finally:
        asyncio._set_running_loop(None)


@pytest.fixture(scope="session", autouse=True)
def quick_passwords() -> Iterator[None]:
    """A password check costs 0.1 s of a processor on purpose; `test_people` looks at the real parameters."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accounts, "PasswordHasher", partial(PasswordHasher, time_cost=1, memory_cost=64, parallelism=1))
        yield


@pytest.fixture(scope="session", autouse=True)
def databases_that_need_not_last() -> Iterator[None]:
    """No commit waits for the disk: a test's database outlives no machine. `test_session` looks at a real one."""

    def quick(connection: Any, record: Any) -> None:
        DURABLE(connection, record)
        connection.execute("PRAGMA synchronous=OFF")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "_durable_sqlite", quick)
        yield


@pytest.fixture(scope="session", autouse=True)
def one_fork_server() -> Iterator[None]:
    """It loads what any worker of a test needs: without it every process that a test starts would load that anew."""
    with pytest.MonkeyPatch.context() as patch:
        loaded = [worker.VERBS, "tests.api.stub_worker", "stimrig.api.cohort.record"]
        patch.setattr(process._Context, "set_forkserver_preload", lambda *_: set_forkserver_preload(loaded))
        yield


@pytest.fixture(scope="session", autouse=True)
def no_database_on_the_event_loop() -> Iterator[None]:
    """A database that does not answer holds up whoever asks it; on the event loop that would be every stop, too."""

    def off_the_loop(ask: Callable[..., Any]) -> Callable[..., Any]:
        def asked(store: Store) -> Any:
            if threading.current_thread() is not threading.main_thread():  # there playwright's loop runs
                with pytest.raises(RuntimeError):
                    asyncio.get_running_loop()
            return ask(store)

        return asked

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "read", off_the_loop(Store.read))
        patch.setattr(Store, "write", off_the_loop(Store.write))
        yield


class SetClock(Clock):
    """Both clocks stand where a test sets them."""

    def __init__(self) -> None:
        self.unix, self.now_s = 1_800_000_000.0, 1000.0

    def unix_s(self) -> float:
        return self.unix

    def monotonic_s(self) -> float:
        return self.now_s


@dataclass
class Service:
    """A running service and ways to it."""

    url: str
    app: Any
    rig_thread: RigThread
    data: Path

    @property
    def rig(self) -> FakeRig:
        return self.rig_thread.rig

    @property
    def context(self) -> Any:
        return self.app.state.context

    def run(self, work: Any) -> Any:
        """What a coroutine of the service gives, on the service's own loop."""
        return asyncio.run_coroutine_threadsafe(work, self.context.rig._task.get_loop()).result(30)

    def live(self, test_id: str, token: str | None = TOKEN, **headers: str) -> ClientConnection:
        """A test's live channel."""
        head = headers | ({"Authorization": f"Bearer {token}"} if token else {})
        url = self.url.replace("http", "ws") + f"/v1/tests/{test_id}/live"
        return connect(url, additional_headers=head, open_timeout=60)

    def change(self, table: Any, key: Any, **fields: Any) -> None:
        """Done to a row behind the service's back: new values, or functions of the old ones."""
        with self.context.store.write() as session:
            row = session.get(table, key)
            for name, value in fields.items():
                setattr(row, name, value(getattr(row, name)) if callable(value) else value)

    def client(self, token: str | None = TOKEN, **more: Any) -> httpx.Client:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        headers |= more.pop("headers", {})
        more = {"timeout": PATIENCE_S, "verify": NO_TLS, "auth": LooksFirst()} | more
        client = httpx.Client(base_url=self.url, headers=headers, **more)
        client.rig_thread = self.rig_thread  # type: ignore[attr-defined]  # for `run_test`
        return client

    def play_test(self, code: str) -> dict[str, Any]:
        """A participant's test, played to its end; who is not there yet is made."""
        with self.client() as http:
            return play_test(http, code)

    def sql(self, statement: str) -> Any:
        """Done to the database behind the service's back; what it answers."""
        with self.context.store.write() as session:
            done = session.execute(text(statement))
            return done.all() if done.returns_rows else []

    def token(self, name: str, *scopes: str) -> str:
        with self.client() as client:
            return client.post("/v1/tokens", json={"name": name, "scopes": list(scopes)}).json()["token"]


class PromptServer(uvicorn.Server):
    """Ends when it is told to; uvicorn looks for that ten times a second, and waits as long for each connection."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.up = threading.Event()
        self.down: asyncio.Event
        self.loop: asyncio.AbstractEventLoop

    async def main_loop(self) -> None:
        self.loop, self.down = asyncio.get_running_loop(), asyncio.Event()
        await self.on_tick(0)
        self.up.set()
        await self.down.wait()

    async def shutdown(self, sockets: Any = None) -> None:  # noqa: ARG002
        for server in self.servers:
            server.close()
        for connection in list(self.server_state.connections):
            connection.shutdown()
        end = time.monotonic() + 10
        while (self.server_state.connections or self.server_state.tasks) and time.monotonic() < end:
            await asyncio.sleep(0.002)
        await self.lifespan.shutdown()


class Server:
    """uvicorn in a thread."""

    def __init__(self, app: Any, **more: Any) -> None:
        self.server = PromptServer(
            configuration(app, port=0, log_level="warning", ws_ping_interval=None, lifespan="on", **more)
        )

    def __enter__(self) -> str:
        self.thread = threading.Thread(target=self.server.run, daemon=True)
        self.thread.start()
        soon(lambda: self.server.up.wait(0.5) or not self.thread.is_alive(), PATIENCE_S)
        port = self.server.servers[0].sockets[0].getsockname()[1]
        return f"http://127.0.0.1:{port}"

    def __exit__(self, *_: object) -> None:
        self.server.loop.call_soon_threadsafe(self.server.down.set)
        self.thread.join(10)


@pytest.fixture(scope="session")
def short_dir() -> Iterator[Path]:
    """A folder with a short name: a Unix socket's path holds 107 characters."""
    path = Path(tempfile.mkdtemp(prefix="stimrig-"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.fixture(scope="module")
def shared_client(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[httpx.Client]:
    """The administrator's client of a service that a module's tests share: for tests that leave nothing behind."""
    for service in run_service(tmp_path_factory.mktemp("shared"), short_dir, STUB):
        with service.client() as client:
            yield client


@cache
def empty_database() -> bytes:
    """SQLite's file with the tables of today, made once a process: each fresh service gets a copy."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "empty.sqlite"
        Store(f"sqlite:///{path}").close()
        return path.read_bytes()


def put_database(folder: Path) -> None:
    """An empty one with the tables of today, where there is none yet."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "stimrig.db").exists():
        (folder / "stimrig.db").write_bytes(empty_database())


def run_service(tmp_path: Path, short_dir: Path, worker: Any, speed: float = 30.0, **more: Any) -> Iterator[Service]:
    socket = short_dir / f"rig-{time.time_ns()}.sock"
    settings = Settings(data_dir=tmp_path, admin_token=TOKEN, rig_socket=socket, port=0, **more)
    if settings.database == f"sqlite:///{tmp_path / 'stimrig.db'}":
        put_database(tmp_path)
    with RigThread(socket, settings.recordings_dir, speed=speed) as rig:
        app = create_app(settings, worker=worker)
        with Server(app) as url:
            yield Service(url, app, rig, tmp_path)


@contextmanager
def serving(*given: Any, **more: Any) -> Iterator[tuple[Service, httpx.Client]]:
    """A service, and the administrator's client of it."""
    for service in run_service(*given, **more):
        with service.client() as client:
            yield service, client


def shared_service(worker: Any = STUB, **more: Any) -> Any:
    """A fixture of a module: one service for all its tests."""

    @pytest.fixture(scope="module")
    def shared(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Service]:
        yield from run_service(tmp_path_factory.mktemp("shared"), short_dir, worker, **more)

    return shared


def own_service(worker: Any = STUB, **more: Any) -> Any:
    """A fixture: a service of its own for each test."""

    @pytest.fixture
    def own(tmp_path: Path, short_dir: Path) -> Iterator[Service]:
        yield from run_service(tmp_path, short_dir, worker, **more)

    return own


service = own_service()


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Debian's chromium, once a test process."""
    from tests.api.browser import ARGUMENTS, CHROMIUM

    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("Debian's chromium is not installed (apt-get install chromium-headless-shell)")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        LOOPS.append(asyncio._get_running_loop())
        yield chromium
        asyncio._set_running_loop(LOOPS.pop())
        chromium.close()
    asyncio._set_running_loop(None)


@pytest.fixture
def tab(browser: Any, service: Service) -> Iterator[Any]:
    """A signed-in tab that takes down every request, error and console message."""
    from tests.api.browser import open_tab

    yield from open_tab(browser, service)


@pytest.fixture
def client(service: Service) -> Iterator[httpx.Client]:
    """The administrator's client."""
    with service.client() as client:
        yield client


@pytest.fixture
def participant(client: httpx.Client) -> str:
    assert client.post("/v1/participants", json={"code": "P017"}).status_code == 201
    return "P017"


@pytest.fixture(scope="module")
def s3() -> Iterator[Any]:
    """A server of S3 in this process, and the variables by which fsspec and botocore find it."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    given = {
        "AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in given.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()  # one of another module would ask that one's server
        yield s3fs.S3FileSystem(anon=False)
    server.stop()


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of a made-up muscle's test."""
    from tests.api.test_jobs import made_up_csv

    return made_up_csv(tmp_path_factory.mktemp("record") / "record.csv")


@pytest.fixture(scope="module")
def model(record: Path) -> Path:
    """MODEL.json beside it, made by the command line."""
    path = record.with_name("MODEL.json")
    assert main.run(["fit", str(record), "-o", str(path)]) == 0
    return path


@pytest.fixture
def approved(client: httpx.Client, participant: str) -> str:
    """The participant's model, in use."""
    model: str = run_test(client, participant)["model_id"]
    assert client.post(f"/v1/models/{model}/approve").status_code == 200
    return model


@contextmanager
def signed_in(service: Service, token: str = TOKEN) -> Iterator[httpx.Client]:
    with service.client(token=None, headers=HTML, follow_redirects=False) as browser:
        answer = browser.post("/v1/sessions", data={"token": token})
        assert answer.status_code == 303, answer.text
        cookie = answer.headers["set-cookie"]
        assert "HttpOnly" in cookie and "SameSite=strict" in cookie
        yield browser


PASSWORD = "correct horse battery"


def person(service: Service, name: str = "Ada", password: str = PASSWORD, **more: Any) -> httpx.Client:
    """The browser of a person who has signed in; who is not there yet is added. It sends the session's CSRF token."""
    with service.client() as admin:
        added = admin.post("/v1/users", json={"name": name, "password": password, **more})
        assert added.status_code in (201, 409), added.text
    browser = service.client(token=None)
    signed = browser.post("/v1/sessions", json={"name": name, "password": password})
    assert signed.status_code == 201, signed.text
    browser.headers["X-CSRF-Token"] = signed.json()["csrf"]
    return browser


@pytest.fixture
def pages(service: Service) -> Iterator[httpx.Client]:
    """The administrator's browser, signed in."""
    with signed_in(service) as browser:
        yield browser


def soon(found: Callable[[], Any], limit_s: float = 60.0) -> Any:
    """What is found, once it is something."""
    end, pause_s = time.monotonic() + limit_s, 0.005
    while not (value := found()):
        assert time.monotonic() < end, value
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, 0.05)
    return value


def wait_done(client: httpx.Client, test_id: str, limit_s: float = 120.0) -> dict[str, Any]:
    """Poll a test to its end."""
    return soon(lambda: (test := client.get(f"/v1/tests/{test_id}").json())["done"] and test, limit_s)


def let_go(client: httpx.Client) -> bool:
    """Wait until the rig is free: a test is seen to be done a moment before that."""
    return soon(lambda: client.get("/v1/rig").json()["holder"] is None, 20.0)


def run_test(client: httpx.Client, participant: str, limit_s: float = 120.0) -> dict[str, Any]:
    """Start a test and follow it to its end; nobody looks at it on its way, so the rig is quick."""
    rig = client.rig_thread.rig  # type: ignore[attr-defined]
    before, rig.speed = rig.speed, QUICK_SPEED
    try:
        started = client.post("/v1/tests", json={"participant": participant})
        assert started.status_code == 202, started.text
        return wait_done(client, started.json()["id"], limit_s)
    finally:
        rig.speed = before


def play_test(client: httpx.Client, code: str) -> dict[str, Any]:
    """A participant's test, played to its end; who is not there yet is made."""
    client.post("/v1/participants", json={"code": code})
    return run_test(client, code)
