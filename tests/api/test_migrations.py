"""A database of an older version is upgraded, one of a newer version or of something else is refused in one line.

`databases` holds dumps of what older versions really made, with a row or two in each.
"""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from stimrig.api.errors import ApiError
from stimrig.api.store import Store, audit, migrations
from stimrig.api.store.tables import Approval, AuditEntry, Participant, Recording, Table, User
from tests.api.conftest import STUB, play_test, run_service, serving

pytestmark = [pytest.mark.sqlite, pytest.mark.slow]
ROOT = Path(__file__).parents[2]
OLD = Path(__file__).parent / "databases"
ADDED_SINCE = [
    ("approvals", "expires_utc"), ("recordings", "warnings"), ("participants", "side"), ("participants", "muscle"),
    ("participants", "archived_utc"), ("tests", "ran_by"), ("models", "carried_from_id"), ("models", "carried"),
    ("page_sessions", "acted_unix_s"), ("page_sessions", "locked_unix_s"), ("approvals", "tracking"),
    ("tokens", "participant"), ("tokens", "plan"), ("tokens", "made_by"),
    ("tests", "followed_by"), ("tests", "rig"),
    ("participants", "placement"), ("recordings", "site"), ("approvals", "site"),
    ("approvals", "undone"), ("participants", "channels"),
]  # fmt: skip
"""Columns that the tables of a first database did not have."""
NEWER = "UPDATE alembic_version SET version_num = '0900'"


def change(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            database.execute(statement)


def old(path: Path, name: str) -> Path:
    """A database as an older version left it."""
    with closing(sqlite3.connect(path)) as database:
        database.executescript((OLD / f"{name}.sql").read_text())
    return path


def differences(store: Store) -> list[object]:
    with store.engine.connect() as connection:
        return [
            found
            for found in compare_metadata(MigrationContext.configure(connection), Table.metadata)
            if found[0] != "remove_table" or found[1].name != "schema_version"
        ]


def test_a_new_database_is_at_the_newest_revision_and_holds_the_tables_of_today(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path}/stimrig.db")
    assert differences(store) == []
    store.close()
    with closing(sqlite3.connect(tmp_path / "stimrig.db")) as database:
        assert database.execute("SELECT version_num FROM alembic_version").fetchone() == (migrations.NEWEST,)


@pytest.mark.parametrize("name", ["unversioned", "2", "3", "4", "5", "6", "12"])
def test_a_database_of_each_older_version_is_upgraded_and_keeps_its_rows(tmp_path: Path, name: str) -> None:
    path = old(tmp_path / "stimrig.db", name)
    for _ in range(2):  # the second time there is nothing to do
        store = Store(f"sqlite:///{path}")
        assert differences(store) == []
        assert [row.code for row in store.all(Participant)] == ["P1"]
        ended = [("m1", "2026-11-24T00:00:00.000Z")] if name == "12" else []
        assert [(row.model_id, row.expires_utc) for row in store.all(Approval)] == [*ended, ("m1", None)]
        assert [row.id for row in store.all(Recording)] == ["r1" if name == "12" else "upload-1"]
        entries = store.all(AuditEntry)
        assert len(entries) == 1 and audit.first_broken(entries) is None
        store.close()


def test_the_names_of_people_who_are_there_are_folded(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{old(tmp_path / 'stimrig.db', '5')}")
    assert [(row.name, row.folded_name) for row in store.all(User)] == [("Jörg  MÜLLER", "jörg müller")]
    store.close()


def test_what_an_unversioned_database_lacks_or_has_already_makes_no_difference(tmp_path: Path) -> None:
    """As before approvals ended with their day; and with people, but no version yet."""
    before = old(tmp_path / "before.db", "unversioned")
    change(before, "ALTER TABLE approvals DROP COLUMN expires_utc")
    people = old(tmp_path / "people.db", "2")
    change(people, "DROP TABLE schema_version")
    for path in (before, people):
        store = Store(f"sqlite:///{path}")
        assert differences(store) == []
        store.close()


def test_an_upgrade_that_fails_leaves_the_database_as_it_was(tmp_path: Path) -> None:
    path = old(tmp_path / "stimrig.db", "2")
    change(path, "ALTER TABLE models DROP COLUMN etag")
    with closing(sqlite3.connect(path)) as database:
        before = list(database.iterdump())
    with pytest.raises(ApiError, match="table models lacks etag"):
        Store(f"sqlite:///{path}")
    with closing(sqlite3.connect(path)) as database:
        assert list(database.iterdump()) == before


def test_a_service_goes_on_with_an_older_database(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, STUB) as (_, http):
        model = play_test(http, "P1")["model_id"]
        http.post(f"/v1/models/{model}/approve", json={"reason": "good"})
    change(
        tmp_path / "stimrig.db", "DROP TABLE alembic_version", "DROP TABLE schema_version", "DROP TABLE confirmations",
        "DROP TABLE known_places", "DROP TABLE identities", "DROP TABLE erasures",
        "DROP TABLE users", "DROP TABLE notes", "DROP TABLE tracked", "DROP TABLE searches",
        "DROP TABLE secrets",
        "DROP TABLE outbox", "DROP INDEX ix_audit_subject",
        *(f"DROP TABLE {table}" for table in Table.metadata.tables if table.startswith("centre_")),
        *(f"ALTER TABLE {table} DROP COLUMN {column}" for table, column in ADDED_SINCE),
    )  # fmt: skip
    for service in run_service(tmp_path, short_dir, STUB):
        assert httpx.get(f"{service.url}/health", timeout=60).json()["database"] == "ok"
        with service.client() as http:
            assert http.get("/v1/participants/P1/model").json()["model_id"] == model
            assert http.get("/v1/audit").json()["whole"]
            assert http.post("/v1/users", json={"name": "Ada", "password": "long enough"}).status_code == 201


@pytest.mark.parametrize(
    ("statements", "words"),
    [
        ((NEWER,), "it is of version 0900, .* install the stimrig that wrote it"),
        (("DROP TABLE alembic_version", "UPDATE schema_version SET version = 9"), "version 9, .* install the stimrig"),
        (("ALTER TABLE models DROP COLUMN etag",), "table models lacks etag"),
        (("DROP TABLE confirmations",), "no table confirmations"),
    ],
    ids=["newer", "numbered-newer", "not-to-be-made-up", "table-gone"],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, statements: tuple[str, ...], words: str) -> None:
    path = tmp_path / "stimrig.db"
    Store(f"sqlite:///{path}").close()
    change(path, *statements)
    before = path.read_bytes()
    with pytest.raises(ApiError, match=words):
        Store(f"sqlite:///{path}")
    assert path.read_bytes() == before, "nothing was changed in it"


def test_an_older_stimrig_refuses_a_database_of_today(tmp_path: Path) -> None:
    """It read `schema_version` and knew numbers up to 4."""
    Store(f"sqlite:///{tmp_path}/stimrig.db").close()
    with closing(sqlite3.connect(tmp_path / "stimrig.db")) as database:
        assert database.execute("SELECT MAX(version) FROM schema_version").fetchone()[0] > 4


def test_the_service_says_so_in_one_line_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "stimrig.db"
    Store(f"sqlite:///{path}").close()
    change(path, NEWER)
    environment = {**os.environ, "STIMRIG_DATA_DIR": str(tmp_path), "STIMRIG_PORT": "0"}
    command = [sys.executable, "-m", "stimrig.api.web.server"]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and len(lines) == 1 and "version 0900" in lines[0], done.stderr
    path.write_bytes(b"not a database at all" * 100)
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and len(lines) == 1 and "restore the database from a backup" in lines[0], done.stderr
