"""A database of an older version is upgraded, one of a newer version or of something else is refused in one line."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from api.errors import ApiError
from api.store import Store, migrations
from api.store.tables import Approval, Participant
from tests.api.conftest import STUB, run_service, run_test

ROOT = Path(__file__).parents[2]


def change(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            database.execute(statement)


def test_new_database_says_its_version(tmp_path: Path) -> None:
    Store(f"sqlite:///{tmp_path}/stimrig.db").close()
    with closing(sqlite3.connect(tmp_path / "stimrig.db")) as database:
        assert database.execute("SELECT MAX(version) FROM schema_version").fetchone() == (migrations.VERSION,)


def test_older_database_is_upgraded_and_keeps_its_rows(tmp_path: Path, short_dir: Path) -> None:
    """As it was before versions were kept, before approvals ended with their day, and before there were passwords."""
    for service in run_service(tmp_path, short_dir, STUB):
        with service.client() as http:
            http.post("/v1/participants", json={"code": "P1"})
            model = run_test(http, "P1")["model_id"]
            http.post(f"/v1/models/{model}/approve", json={"reason": "good"})
    path = tmp_path / "stimrig.db"
    change(
        path, "DROP TABLE schema_version", "ALTER TABLE approvals DROP COLUMN expires_utc", "DROP TABLE confirmations",
        "DROP TABLE users",
    )  # fmt: skip
    store = Store(f"sqlite:///{path}")
    assert [row.code for row in store.all(Participant)] == ["P1"]
    (approval,) = store.all(Approval)
    assert approval.model_id == model and approval.expires_utc is None
    store.close()
    for service in run_service(tmp_path, short_dir, STUB):
        with service.client() as http:
            assert http.get("/v1/participants/P1/model").json()["model_id"] == model
            assert http.get("/v1/audit").json()["whole"]
            assert http.post("/v1/users", json={"name": "Ada", "password": "long enough"}).status_code == 201


@pytest.mark.parametrize(
    ("statements", "words"),
    [
        ((f"INSERT INTO schema_version VALUES ({migrations.VERSION + 5})",), "install the stimrig that wrote it"),
        (("DROP TABLE schema_version", "ALTER TABLE models DROP COLUMN etag"), "table models lacks etag"),
    ],
    ids=["newer", "not-to-be-made-up"],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, statements: tuple[str, ...], words: str) -> None:
    path = tmp_path / "stimrig.db"
    Store(f"sqlite:///{path}").close()
    change(path, *statements)
    before = path.read_bytes()
    with pytest.raises(ApiError, match=words):
        Store(f"sqlite:///{path}")
    assert path.read_bytes() == before, "nothing was changed in it"


@pytest.mark.slow
def test_the_service_says_so_in_one_line_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "stimrig.db"
    Store(f"sqlite:///{path}").close()
    change(path, f"INSERT INTO schema_version VALUES ({migrations.VERSION + 1})")
    environment = {**os.environ, "STIMRIG_DATA_DIR": str(tmp_path), "STIMRIG_PORT": "0"}
    command = [sys.executable, "-m", "api.web.server"]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and len(lines) == 1 and f"version {migrations.VERSION + 1}" in lines[0], done.stderr
    path.write_bytes(b"not a database at all" * 100)
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and len(lines) == 1 and "restore the database from a backup" in lines[0], done.stderr


def test_health_answers_after_an_upgrade(tmp_path: Path, short_dir: Path) -> None:
    Store(f"sqlite:///{tmp_path}/stimrig.db").close()
    change(tmp_path / "stimrig.db", "DROP TABLE schema_version")
    for service in run_service(tmp_path, short_dir, STUB):
        assert httpx.get(f"{service.url}/health", timeout=60).json()["database"] == "ok"
