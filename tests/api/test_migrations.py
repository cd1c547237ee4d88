"""The database is upgraded whole or refused in one line; a backup of all data is one state, and can be restored."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from stimrig.api.cli import main
from stimrig.api.cli.commands import backup
from stimrig.api.errors import ApiError
from stimrig.api.store import Store, copies, migrations
from stimrig.api.store.tables import Participant, Recording, Table, Test
from stimrig.api.whole_file import sha256_of
from stimrig.rig.control.memory import LatchFile
from tests.api.test_schemas import unmet
from tests.simulator.virtual_time import VirtualMachine

ROOT = Path(__file__).parents[2]
NEWER = "UPDATE alembic_version SET version_num = '0900'"
WITH_VERSION = ", ".join([*Test.__table__.columns.keys(), "version BIGINT NOT NULL"])
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
        (
            f"DROP TABLE tests; CREATE TABLE tests ({WITH_VERSION})",
            "the column tests.version is of another stimrig .* set STIMRIG_DATA_DIR to another folder",
        ),
    ],
    ids=["newer", "column-gone", "table-gone", "column-too-many"],
)
def test_what_does_not_fit_is_refused(database: Path, statement: str, words: str) -> None:
    execute(database, *statement.split("; "))
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


# ---- A backup is consistent while service and rig write, checked, and comes up latched where it is restored.


class Machine:
    """The data folders of rig and service on an installed machine."""

    def __init__(self, root: Path) -> None:
        self.rig, self.api, self.backups = root / "rig", root / "api", root / "backups"
        for folder in (self.rig / "journals", self.rig / "recordings", self.api / "recordings/rig"):
            folder.mkdir(parents=True)
        with closing(Store(f"sqlite:///{self.api}/stimrig.db")) as store, store.write() as session:
            session.add(Participant(code="P1", created_utc="2026-11-23T10:00:00.000Z", created_by="Ada"))
        self.record(self.rig / "recordings/20260101T080000Z_t1.h5", b"first" * 1000)
        self.record(self.rig / "recordings/20260101T090000Z_t2.h5", os.urandom(100_000))
        self.record(self.api / "recordings/upload-aa.csv", b"time_s,torque_nm\n")
        (self.rig / "journals/t3.journal").write_bytes(b"running")
        (self.rig / "recordings/.half.h5.x").write_bytes(b"not yet renamed")

    def record(self, path: Path, content: bytes) -> None:
        """A recording that is sealed, and then named by the database."""
        path.write_bytes(content)
        with closing(Store(f"sqlite:///{self.api}/stimrig.db")) as store, store.write() as session:
            row = Recording(id=path.stem, participant="P1", path=str(path), file_sha256=sha256_of(path))
            row.created_utc = "2026-11-23T10:00:00.000Z"
            session.add(row)

    def back_up(self, capsys: pytest.CaptureFixture[str]) -> Path:
        assert main.run(["backup", str(self.backups), *self.folders, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert unmet("backup", found) == [] and found["database"]
        return Path(found["backup"])

    @property
    def folders(self) -> list[str]:
        return ["--data", str(self.api), "--rig-data", str(self.rig)]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_all_is_in_it_for_its_owner_only_and_can_be_checked_again(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = machine.back_up(capsys)
    assert names(kept) == {
        "SHA256SUMS", "api/stimrig.db", "api/recordings/upload-aa.csv", "rig/journals/t3.journal", "rig/latch.json",
        "rig/recordings/20260101T080000Z_t1.h5", "rig/recordings/20260101T090000Z_t2.h5",
    }  # fmt: skip
    assert kept.stat().st_mode & 0o077 == 0
    check = ["sha256sum", "--check", "--quiet", "--strict", "SHA256SUMS"]
    assert subprocess.run(check, cwd=kept).returncode == 0
    (kept / "rig/recordings/20260101T080000Z_t1.h5").write_bytes(b"First" * 1000)
    assert subprocess.run(check, cwd=kept, capture_output=True).returncode == 1


@pytest.mark.parametrize(
    ("latch", "state"),
    [
        (None, "latched"),
        (b'{"state": "latched", "reason": "stopped"}', "latched"),
        (b'{"state": "running", "reason": "test t3"}', "running"),
        (b"[" * 100_000, "running"),
    ],
)
def test_restored_by_hand_the_rig_comes_up_latched_or_uncertain(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str], latch: bytes | None, state: str
) -> None:
    """As docs/operation.md says: rig and service kept in one folder here."""
    if latch is not None:
        (machine.rig / "latch.json").write_bytes(latch)
    kept, new = machine.back_up(capsys), tmp_path / "new"
    shutil.copytree(kept / "api", new)
    shutil.copytree(kept / "rig", new, dirs_exist_ok=True)
    there = VirtualMachine()
    found, reason = there.run(LatchFile(new, there).read())
    assert found == state and (kept.name in reason) == (state == "latched")
    with closing(Store(f"sqlite:///{new}/stimrig.db")) as store:
        assert len(store.all(Recording)) == 3
    assert (new / "recordings/20260101T080000Z_t1.h5").read_bytes() == b"first" * 1000


def test_one_folder_for_rig_and_service(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(machine.rig, machine.api, dirs_exist_ok=True)
    machine.rig = machine.api
    assert names(machine.back_up(capsys)) > {"api/stimrig.db", "rig/recordings/upload-aa.csv"}


def test_a_backup_while_it_is_written_to_is_one_state(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    end = threading.Event()

    def write() -> None:
        number = 0
        while not end.is_set():
            number += 1
            journal = machine.rig / f"journals/w{number}.journal"
            journal.write_bytes(b"w" * number)
            machine.record(machine.rig / f"recordings/20260101T1{number:05}Z_w{number}.h5", b"w" * number)
            journal.unlink()

    writer = threading.Thread(target=write)
    writer.start()
    try:
        kept = [machine.back_up(capsys) for _ in range(3)]
    finally:
        end.set()
        writer.join()
    for folder in kept:  # what the database names is there, and no test twice
        with closing(sqlite3.connect(folder / backup.DATABASE)) as database:
            rows = database.execute("SELECT path FROM recordings").fetchall()
        found = names(folder / "rig/recordings") | names(folder / "api/recordings")
        assert {Path(path).name for (path,) in rows} <= found
        sealed = {name.partition("Z_")[2].removesuffix(".h5") for name in found}
        assert not sealed & {name.removesuffix(".journal") for name in names(folder / "rig/journals")}


@pytest.mark.parametrize("spoil", ["differs from what the database says", "is missing"])
def test_a_damaged_recording_is_named_and_the_others_are_saved(
    machine: Machine, spoil: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = machine.rig / "recordings/20260101T080000Z_t1.h5"
    recording.unlink() if spoil == "is missing" else recording.write_bytes(b"First" * 1000)
    assert main.run(["backup", str(machine.backups), *machine.folders, "--json"]) == 1
    output = capsys.readouterr()
    report = json.loads(output.out)
    assert unmet("backup", report) == [] and report["damaged"] == [f"{recording}: the recording {spoil}"]
    assert output.err.count("\n") == 1 and f"{recording}: the recording {spoil}" in output.err
    assert "rig/recordings/20260101T090000Z_t2.h5" in names(Path(report["backup"]))


def test_a_bad_disk_leaves_no_backup(
    machine: Machine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backup, "sha256_of", lambda _: "0" * 64)
    assert main.run(["backup", str(machine.backups), *machine.folders]) == 1
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "is the disk sound?" in line and list(machine.backups.iterdir()) == []


def test_without_a_database_it_says_what_to_do(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main.run(["backup", str(tmp_path / "b"), "--data", str(tmp_path / "nowhere")]) == 2
    assert "no database" in capsys.readouterr().err
    monkeypatch.setenv("STIMRIG_DATABASE_URL", "postgresql://db/stimrig")
    assert main.run(["backup", str(machine.backups), *machine.folders]) == 0
    assert "pg_dump" in capsys.readouterr().out
    (kept,) = machine.backups.iterdir()
    assert not (kept / "api/stimrig.db").exists() and (kept / "rig/journals/t3.journal").exists()
