"""A centre on a real port, on SQLite with a folder as its bucket."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.centre.app import create_app
from stimrig.api.centre.context import CentreSettings
from stimrig.api.clock import Clock
from stimrig.api.store.centre_tables import CentreRig
from tests.api.conftest import PATIENCE_S, TOKEN, Server
from tests.harness.postgres import Cluster


@pytest.fixture(scope="session", autouse=True)
def centres_keep_it_there_too(kept_in_postgresql: Cluster | None) -> Iterator[None]:
    """With `--postgresql`: a centre's database is one in the tests' cluster, another one for each data folder."""
    if kept_in_postgresql is None:
        yield
        return

    def database(settings: CentreSettings) -> str:
        return settings.database_url or kept_in_postgresql.database(str(settings.data_dir.absolute()))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CentreSettings, "database", property(database))
        yield


class SetClock(Clock):
    """The world's clock, so many seconds later."""

    def __init__(self) -> None:
        self.later_s = 0.0

    def unix_s(self) -> float:
        return super().unix_s() + self.later_s


@dataclass
class Centre:
    """A running centre and ways to it."""

    url: str
    app: Any
    data: Path
    clock: SetClock

    @property
    def context(self) -> Any:
        return self.app.state.context

    def client(self, token: str | None = TOKEN, **more: Any) -> httpx.Client:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=PATIENCE_S, **more)

    def key(self, name: str = "Ward 1") -> str:
        with self.client() as http:
            answer = http.post("/v1/rigs", json={"name": name})
            assert answer.status_code == 201, answer.text
            return answer.json()["key"]

    def warnings(self) -> list[tuple[str | None, str]]:
        with self.client() as http:
            return [(one["rig"], one["kind"]) for one in http.get("/v1/warnings").json()]

    def row(self, name: str = "Ward 1") -> CentreRig:
        return self.context.rigs.named(name)


def run_centre(data: Path, **more: Any) -> Iterator[Centre]:
    clock = SetClock()
    settings = CentreSettings(**{"data_dir": data, "admin_token": TOKEN, "port": 0} | more)
    with ThreadPoolExecutor(1) as apart:  # a browser's driver keeps an event loop in this one
        app = apart.submit(create_app, settings, clock).result()
    with Server(app) as url:
        yield Centre(url, app, data, clock)


@pytest.fixture
def centre(tmp_path: Path) -> Iterator[Centre]:
    yield from run_centre(tmp_path / "centre")


@pytest.fixture
def rig(centre: Centre) -> Iterator[httpx.Client]:
    """A client with the key of the rig `Ward 1`."""
    with centre.client(centre.key()) as http:
        yield http


@pytest.fixture
def http(centre: Centre) -> Iterator[httpx.Client]:
    """The administrator's client."""
    with centre.client() as http:
        yield http
