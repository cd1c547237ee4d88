"""A database of a newer version or of something else is refused in one line; an upgrade is whole, and copied before."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from stimrig.api.errors import ApiError
from stimrig.api.store import Store, copies, migrations
from stimrig.api.store.tables import Participant, Table

ROOT = Path(__file__).parents[2]
NEWER = "UPDATE alembic_version SET version_num = '0900'"
NEXT = """
import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    op.add_column("participants", sa.Column("shoe_size", sa.Integer))
    op.execute({statement!r})
"""
"""A revision that the software may have one day."""


def execute(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            database.execute(statement)


def dump(path: Path) -> list[str]:
    with closing(sqlite3.connect(path)) as database:
        return list(database.iterdump())


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """A database of today's version with a participant."""
    path = tmp_path / "stimrig.db"
    with closing(Store(f"sqlite:///{path}")) as store, store.write() as session:
        session.add(Participant(code="P1", created_utc="2026-11-23T10:00:00.000Z", created_by="Ada"))
    return path


@pytest.fixture
def revisions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of revisions, to which a test may add one."""
    folder = tmp_path / "revisions"
    shutil.copytree(migrations.REVISIONS, folder)
    monkeypatch.setattr(migrations, "REVISIONS", folder)
    return folder / "versions"


def test_a_new_database_holds_the_tables_of_today(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path}/stimrig.db")
    with store.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Table.metadata) == []
    store.close()
    assert not (tmp_path / migrations.BEFORE).exists()
    columns = [column for table in Table.metadata.sorted_tables for column in table.columns]
    assert not [column for column in columns if getattr(column.type, "length", None)], "as SQLite holds none to it"


def test_an_upgrade_keeps_the_rows_and_a_copy_of_the_database_as_it_was(database: Path, revisions: Path) -> None:
    before = dump(database)
    (revisions / "0002.py").write_text(NEXT.format(statement="UPDATE participants SET shoe_size = 43"))
    for _ in range(2):  # the second start has nothing to do
        Store(f"sqlite:///{database}").close()
        with closing(sqlite3.connect(database)) as connection:
            assert connection.execute("SELECT code, shoe_size FROM participants").fetchall() == [("P1", 43)]
    (copy,) = (database.parent / migrations.BEFORE).iterdir()
    assert dump(copy) == before and copy.stat().st_mode & 0o077 == 0


def test_an_upgrade_that_fails_or_cannot_be_copied_leaves_the_database_as_it_was(
    database: Path, revisions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = dump(database)
    (revisions / "0002.py").write_text(NEXT.format(statement="UPDATE nowhere SET shoe_size = 43"))
    with pytest.raises(ApiError, match="no such table: nowhere"):
        Store(f"sqlite:///{database}")
    assert dump(database) == before and not list((database.parent / migrations.BEFORE).iterdir())

    def full(*_: object) -> str:
        raise copies.CopyError("no space left; free some disk space")

    monkeypatch.setattr(copies, "copy_database", full)
    with pytest.raises(ApiError, match="is upgraded only with a copy: no space left"):
        Store(f"sqlite:///{database}")
    assert dump(database) == before


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        (NEWER, "it is of version 0900, .* install the stimrig that wrote it"),
        ("ALTER TABLE models DROP COLUMN etag", "no column models.etag"),
        ("DROP TABLE notes", "no column notes.id"),
    ],
    ids=["newer", "column-gone", "table-gone"],
)
def test_what_does_not_fit_is_refused(database: Path, statement: str, words: str) -> None:
    execute(database, statement)
    before = database.read_bytes()
    with pytest.raises(ApiError, match=words):
        Store(f"sqlite:///{database}")
    assert database.read_bytes() == before, "nothing was changed in it"


@pytest.mark.slow
def test_the_service_says_so_in_one_line_and_ends(database: Path) -> None:
    execute(database, NEWER)
    environment = {**os.environ, "STIMRIG_DATA_DIR": str(database.parent), "STIMRIG_PORT": "0"}
    command = [sys.executable, "-m", "stimrig.api.web"]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and len(lines) == 1 and "version 0900" in lines[0], done.stderr
