"""Clients of two generators, made of our OpenAPI document, compile and run a controller's whole day."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from stimrig.api.workers.pool import WORKER
from tests.api.browser import bring_to_rest
from tests.api.conftest import Service, run_service, run_test

HERE = Path(__file__).parent
SCOPES = ("read-model", "read-live", "run-test")
MADE = HERE.parents[2] / "build" / "generated"
"""Where the packages of the second generator are put, once."""
LIMIT_S = 300


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Service]:
    """A service with a real model, approved for P1."""
    for made in run_service(tmp_path_factory.mktemp("day"), short_dir, WORKER):
        with made.client() as http:
            http.timeout = httpx.Timeout(120)
            http.post("/v1/participants", json={"code": "P1"}).raise_for_status()
            model = run_test(http, "P1", 120.0)["model_id"]
            http.post(f"/v1/models/{model}/approve", json={"reason": "fits well"}).raise_for_status()
        yield made


@pytest.fixture
def document(service: Service, tmp_path: Path) -> Iterator[Path]:
    with service.client() as http:
        (tmp_path / "openapi.json").write_bytes(http.get("/openapi.json").content)
    yield tmp_path / "openapi.json"
    bring_to_rest(service)  # the day ends with a stop


def ran(*command: object, cwd: Path, **more: str) -> str:
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, timeout=LIMIT_S, env=os.environ | more
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return done.stdout


def check(saw: str) -> None:
    found = json.loads(saw.splitlines()[-1])
    assert found.pop("sample_rate_hz") > 40 and found.pop("trials") >= 0
    assert found == {
        "again": 304, "torques": 3, "widths": 100, "state": "completed", "record": b"\x89HDF".hex(),
        "missing": "No such model", "stopped": 200,
    }  # fmt: skip


def installed(what: Path, into: Path, *commands: tuple[object, ...]) -> None:
    """What a generator needs, in a folder of its own, once; its packages do not go with ours. Skips without them."""
    mark = into / what.name
    if not mark.exists() or mark.read_bytes() != what.read_bytes():
        shutil.rmtree(into, ignore_errors=True)
        into.mkdir(parents=True)
        for one in sorted(HERE.glob("*.json")):
            shutil.copy(one, into)
        for command in commands:
            got = subprocess.run(list(map(str, command)), cwd=into, capture_output=True, text=True)
            if got.returncode:
                pytest.skip(f"the packages could not be had: {got.stderr[-300:]}")
        shutil.copy(what, mark)


def test_a_python_client_runs_a_controllers_day(service: Service, document: Path, tmp_path: Path) -> None:
    lock, place = HERE / "requirements.txt", MADE / "python"
    programs = place / "venv" / "bin"
    get = (programs / "pip", "install", "--quiet", "--require-hashes", "-r", lock)
    installed(lock, place, (sys.executable, "-m", "venv", "venv"), get)
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    generate = (programs / "openapi-python-client", "generate", "--path", document)
    told = ran(*generate, "--meta", "none", "--output-path", "made", cwd=tmp_path, PATH=path)
    assert "WARNING" not in told and "Unable" not in told, told
    ran(sys.executable, "-m", "compileall", "-q", "made", cwd=tmp_path)
    shutil.copy(HERE / "day.py", tmp_path)
    check(ran(programs / "python", "day.py", service.url, service.token("controller", *SCOPES), "P1", cwd=tmp_path,
              PYTHONPATH=str(tmp_path)))  # fmt: skip


@pytest.mark.skipif(shutil.which("npm") is None, reason="no npm: install Debian's nodejs and npm")
def test_a_typescript_client_runs_a_controllers_day(service: Service, document: Path, tmp_path: Path) -> None:
    place = MADE / "typescript"
    installed(HERE / "package-lock.json", place, ("npm", "ci", "--no-audit", "--no-fund"))
    for name in ("day.ts", "tsconfig.json"):
        shutil.copy(HERE / name, tmp_path)
    (tmp_path / "node_modules").symlink_to(place / "node_modules")
    ran("node_modules/.bin/openapi-ts", "-i", document, "-o", "made", "-c", "@hey-api/client-fetch", cwd=tmp_path)
    ran("node_modules/.bin/tsc", "-p", ".", cwd=tmp_path)
    check(ran("node", "out/day.js", service.url, service.token("controller", *SCOPES), "P1", cwd=tmp_path))
