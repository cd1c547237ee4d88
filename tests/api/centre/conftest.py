"""A centre on a real port, on SQLite with a folder as its bucket."""

from __future__ import annotations

import hashlib
import json
import secrets
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


# ---- A rig's side of decision 0013, written from its text alone: a chain of items, and its files


ZEROS = "0" * 64
HASHED = ("seq", "kind", "key", "sha256", "file", "file_bytes", "at_utc", "previous")
AT = "2026-03-02T08:00:00.000Z"


def canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def sha256(data: str | bytes) -> str:
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


class Teller:
    """A rig that keeps its chain in memory."""

    def __init__(self, after: dict[str, Any] | None = None) -> None:
        self.chain = secrets.token_hex(16)
        self.items: list[dict[str, Any]] = []
        self.files: dict[str, bytes] = {}
        self.add("begin", self.chain, {"after": after})

    def add(self, kind: str, key: str, body: dict[str, Any], data: bytes | None = None, at: str = AT) -> dict[str, Any]:
        """Append an item; with a file if there is one."""
        item = {"seq": len(self.items) + 1, "kind": kind, "key": key, "body": body, "sha256": sha256(canonical(body))}
        item |= {"file": None if data is None else sha256(data), "file_bytes": None if data is None else len(data)}
        item |= {"at_utc": at, "previous": self.items[-1]["hash"] if self.items else ZEROS}
        item["hash"] = sha256(canonical({name: item[name] for name in HASHED}))
        self.items.append(item)
        if data is not None:
            self.files[item["file"]] = data
        return item

    def session(self, code: str = "P017", day: str = "2026-03-02", number: int = 0, **more: Any) -> bytes:
        """A day: test, recording, model, approval; the recording's bytes."""
        at, name = f"{day}T08:{number:02}:00.000Z", f"{day}-{code}-{number}"
        data = f"HDF5 of {name}{more.get('salt', '')}".encode() * 50
        model = canonical({"model_id": f"m-{name}"}).encode()
        fit = {"verdict": more.get("verdict", "usable"), "fit_percent": 91.5, "noise_sd_nm": 0.12, "figures": {
            "threshold_us": {"value": 101.0 + number, "sd": 1.5, "unit": "µs"},
            "plateau_nm": {"value": 21.5, "sd": 0.2, "unit": "N·m"},
        }}  # fmt: skip
        self.add("participant", code, {"code": code, "side": "left", "muscle": "biceps"}, at=at)
        self.add("recording", f"r-{name}", {
            "id": f"r-{name}", "participant": code, "test_id": f"t-{name}", "origin": "rig", "created_utc": at,
            "file_sha256": sha256(data),
        }, data, at)  # fmt: skip
        self.add("model", f"m-{name}", {
            "id": f"m-{name}", "participant": code, "recording_id": f"r-{name}", "method": "maximum-likelihood",
            "effects": more.get("effects", ["fatigue"]), "fit": fit, "created_utc": at,
        }, model, at)  # fmt: skip
        self.add("test", f"t-{name}", {
            "id": f"t-{name}", "participant": code, "kind": "pre-session", "state": "completed", "reason": "",
            "recording_id": f"r-{name}", "model_id": f"m-{name}", "requested_utc": at,
            "plan": {"profile": {"current_ma": 40.0}},
        }, at=at)  # fmt: skip
        self.add("decision", str(len(self.items)), {
            "model_id": f"m-{name}", "participant": code, "approved": True, "by": "Ada", "at_utc": at,
        }, at=at)  # fmt: skip
        return data

    def hello(self, utc: str, **more: Any) -> dict[str, Any]:
        """A greeting."""
        last = self.items[-1]
        told = {"chain": self.chain, "seq": last["seq"], "hash": last["hash"], "version": "0.1.0", "utc": utc}
        told |= {"disk_free_bytes": 10**11, "disk_total_bytes": 10**12, "state": "ready", "reason": None, "damaged": []}
        return told | {"waiting_items": 0, "waiting_files": 0} | more

    def batch(self, first: int = 1, last: int | None = None) -> dict[str, Any]:
        """Items by their numbers."""
        return {"chain": self.chain, "items": self.items[first - 1 : last]}

    def push(self, rig: httpx.Client) -> None:
        """Everything, as a rig does it."""
        answer = rig.post("/v1/rig/items", json=self.batch())
        assert answer.status_code == 200, answer.text
        for lacking in rig.get("/v1/rig/files").json()["files"]:
            data, have = self.files[lacking["sha256"]], lacking["have_bytes"]
            place = f"/v1/rig/files/{lacking['sha256']}"
            answer = rig.put(f"{place}?offset={have}", content=data[have:])
            if answer.status_code == 409:
                have = answer.json()["have_bytes"]
                answer = rig.put(f"{place}?offset={have}", content=data[have:])
            assert answer.status_code == 200 and answer.json() == {"have_bytes": len(data), "whole": True}, answer.text


@pytest.fixture
def told() -> Teller:
    """What a rig tells, by now its beginning alone."""
    return Teller()
