"""`stimrig centre` at the command line: what it does, and one clear line where it cannot."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from stimrig.api.cli.main import run
from tests.api.centre.conftest import Centre, Teller, sha256
from tests.api.test_schemas import unmet

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("STIMRIG_CENTRE_")]:
        monkeypatch.delenv(name)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """`stimrig centre` as a process: its address, and the token that it printed."""
    command = [sys.executable, "-m", "stimrig", "centre", "--port", "0", "--data", str(tmp_path / "data")]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(3)]
    try:
        yield lines[0].split()[2].rstrip("/"), lines[1].split()[-1]
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        process.stdout.close()


@pytest.mark.slow
def test_it_serves_and_prints_the_first_token_once(served: tuple[str, str], tmp_path: Path) -> None:
    url, token = served
    head = {"Authorization": f"Bearer {token}"}
    with httpx.Client(base_url=url, headers=head, timeout=60, transport=httpx.HTTPTransport(retries=5)) as http:
        assert http.get("/v1/rigs").json() == []
        assert http.get("/health").json()["status"] == "ok"
    assert token not in (tmp_path / "data" / "centre.db").read_bytes().decode("latin-1")


def test_a_rig_is_added_and_revoked(centre: Centre, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--data", str(centre.data)]
    assert run(["centre", "add-rig", "Ward 3", "--url", "https://centre.example.org", *data]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[1] == "STIMRIG_CENTRE_URL=https://centre.example.org"
    key = shown[2].removeprefix("STIMRIG_CENTRE_KEY=")
    with centre.client(key) as rig:
        assert rig.get("/v1/rig/files").status_code == 200
        assert run(["centre", "revoke-rig", "Ward 3", *data]) == 0
        assert rig.get("/v1/rig/files").status_code == 401
    capsys.readouterr()
    for words in (["add-rig", "<b>"], ["revoke-rig", "Ward 4"]):
        assert run(["centre", *words, *data]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert run(["centre", "add-rig", "Ward 3", *data]) == 0, "a new key for it"
    assert run(["centre", "add-rig", "Ward 3", *data]) == 2


def test_a_shell_without_the_centres_settings_makes_no_second_centre(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its keys would open nothing at the real one."""
    monkeypatch.chdir(tmp_path)
    for words in (["add-rig", "Ward 3"], ["revoke-rig", "Ward 3"], ["check"]):
        assert run(["centre", *words]) == 2
        said = capsys.readouterr()
        assert "no centre in ./centre" in said.err and "KEY" not in said.out and said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("STIMRIG_CENTRE_DATA_DIR", str(tmp_path / "set"))
    assert run(["centre", "add-rig", "Ward 3"]) == 0


def test_check_says_what_differs(centre: Centre, rig: httpx.Client, capsys: pytest.CaptureFixture[str]) -> None:
    told = Teller()
    data = told.session()
    told.push(rig)
    centre.clock.later_s = -3600.0
    arguments = ["centre", "check", "--data", str(centre.data), "--since", "2099-01-01T00:00:00Z"]
    assert run(arguments) == 0
    assert "2 files checked, 0 differ" in capsys.readouterr().out
    name = sha256(data)
    (centre.data / "files" / name[:2] / name).write_bytes(b"damaged")
    assert run(arguments) == 1
    assert "2 files checked, 1 differ" in capsys.readouterr().out
    assert run([*arguments, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert unmet("centre", found) == []
    assert found["checked"] == 2 and [one["sha256"] for one in found["differ"]] == [name]
    assert ("Ward 1", "damaged") in centre.warnings()
    assert run([*arguments[:-1], "yesterday"]) == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--host", "0.0.0.0"], "STIMRIG_CENTRE_TLS_PROXY"),
        (["--files", "/proc/nothing/here"], "STIMRIG_CENTRE_FILES"),
        (["--files", "nonsense://bucket"], "STIMRIG_CENTRE_FILES"),
        (["--database", "nonsense"], "database"),
        (["--database", "postgresql+psycopg://nobody:secret@127.0.0.1:1/x"], "127.0.0.1"),
        (["--demo", "--files", "x"], "--demo"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    assert run(["centre", "--port", "0", "--data", str(tmp_path / "data"), *options]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and words in said and "secret" not in said, said


def test_a_missing_extra_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    assert run(["centre", "--port", "0", "--data", str(tmp_path)]) == 2
    assert "pip install 'stimrig[centre]'" in capsys.readouterr().err


@pytest.mark.sqlite
def test_a_database_of_another_version_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    centre = tmp_path / "data"
    assert run(["centre", "add-rig", "Ward 1", "--data", str(centre)]) == 0
    with closing(sqlite3.connect(centre / "centre.db")) as database, database:
        database.execute("UPDATE alembic_version SET version_num = '0900'")
    capsys.readouterr()
    assert run(["centre", "--port", "0", "--data", str(centre)]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "version 0900" in said


def test_a_port_that_is_taken_is_told(centre: Centre, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = centre.url.rpartition(":")[2]
    assert run(["centre", "--port", port, "--data", str(tmp_path / "other")]) == 2
    assert "take another port with --port" in capsys.readouterr().err


def test_settings_name_their_environment(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("STIMRIG_CENTRE_PORT", "many")
    assert run(["centre"]) == 2
    assert "STIMRIG_CENTRE_PORT" in capsys.readouterr().err


def test_the_document_describes_every_route_of_rest(centre: Centre) -> None:
    with centre.client() as http:
        document = http.get("/openapi.json").json()
    assert "/v1/rig/items" in document["paths"] and "/v1/recordings/{recording_id}" in document["paths"]
    put = document["paths"]["/v1/rig/files/{sha256}"]["put"]
    assert "application/octet-stream" in put["requestBody"]["content"] and "507" in put["responses"]
    assert "HTTPValidationError" not in json.dumps(document)
    asking = [one for methods in document["paths"].values() for one in methods.values() if one.get("security")]
    assert len(asking) > 20
    assert all(set(one["responses"]["429"]["headers"]) == {"Retry-After"} for one in asking)
