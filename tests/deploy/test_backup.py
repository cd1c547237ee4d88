"""Backup and restore: consistent while the service writes, checked, and never over what is there."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from stimrig.api.operation import backup, copying
from stimrig.api.operation.copying import DATABASE, BackupError
from stimrig.api.operation.restore import restore

STIMRIG = (sys.executable, "-m", "stimrig", "backup")
"""The name that it had before 1.0."""


class Machine:
    """A data folder for the rig and one for the service, as on an installed machine."""

    def __init__(self, root: Path) -> None:
        self.rig, self.api = root / "lib" / "rig", root / "lib" / "api"
        for folder in (self.rig / "journals", self.rig / "recordings", self.api / "recordings" / "rig"):
            folder.mkdir(parents=True)
        with self.database() as database:
            database.execute("PRAGMA journal_mode=WAL")
            database.execute("CREATE TABLE recordings (path TEXT, file_sha256 TEXT)")
            database.execute("CREATE TABLE pairs (a INTEGER, b INTEGER)")
            database.execute("INSERT INTO pairs VALUES (0, 0)")

    @contextmanager
    def database(self) -> Iterator[sqlite3.Connection]:
        """A connection that commits and closes: `with connect(…)` alone leaves it open."""
        with closing(sqlite3.connect(self.api / "stimrig.db", timeout=10)) as connection, connection:
            yield connection

    def record(self, path: Path, content: bytes) -> None:
        path.write_bytes(content)
        with self.database() as database:
            database.execute("INSERT INTO recordings VALUES (?, ?)", (str(path), hashlib.sha256(content).hexdigest()))

    def contents(self) -> dict[str, bytes]:
        roots = ((self.rig, "journals"), (self.rig, "recordings"), (self.api, "recordings"))
        files = (path for root, folder in roots for path in (root / folder).rglob("*") if path.is_file())
        return {str(path): path.read_bytes() for path in files}


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    made = Machine(tmp_path)
    made.record(made.rig / "recordings" / "20260101T080000Z_t1.h5", b"first" * 1000)
    made.record(made.rig / "recordings" / "20260101T090000Z_t2.h5", os.urandom(100_000))
    made.record(made.api / "recordings" / "upload-aa.csv", b"time_s,torque_nm\n")
    (made.rig / "journals" / "t3.journal").write_bytes(b"running")
    (made.rig / "recordings" / ".half.h5.x").write_bytes(b"not yet renamed")
    return made


def restored(machine: Machine, kept: Path, root: Path) -> Machine:
    """The backup on another machine's empty folders."""
    rig, api = root / "new" / "rig", root / "new" / "api"
    rig.parent.mkdir()
    restore(kept, rig, api, force=False)
    found = object.__new__(Machine)
    found.rig, found.api = rig, api
    return found


def test_root_gives_the_folder_away_last_and_follows_no_link(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the service's user could make root give it any file, by a link in a folder that it already owns."""
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    given: list[Path] = []

    def chown(path: Path, _user: int, _group: int, follow_symlinks: bool = True) -> None:
        assert not follow_symlinks and not path.is_symlink()
        assert not {one for one in given if one in path.parents}, "a folder was given away before what is in it"
        given.append(path)

    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(os, "chown", chown)
    restore(kept, machine.rig, machine.api, force=True)
    roots = {machine.rig.with_name("rig.restoring"), machine.api.with_name("api.restoring")}
    assert roots <= set(given) and len(given) > 10


def test_there_and_back(machine: Machine, tmp_path: Path) -> None:
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    assert backup.check(kept) == {"files": 5, "recordings": 3, "named_in_database": 3}
    assert not list(kept.rglob(".half*"))
    assert kept.stat().st_mode & 0o077 == 0
    new = restored(machine, kept, tmp_path)
    old = {name.replace(str(machine.rig.parent), ""): data for name, data in machine.contents().items()}
    assert {n.replace(str(new.rig.parent), ""): d for n, d in new.contents().items()} == {
        name: data for name, data in old.items() if ".half" not in name
    }
    with new.database() as database:
        assert len(database.execute("SELECT * FROM recordings").fetchall()) == 3
    latch = json.loads((new.rig / "latch.json").read_text())
    assert latch["state"] == "latched"
    assert kept.name in latch["reason"]


def test_the_rig_reads_the_latch_of_restored_data(machine: Machine, tmp_path: Path) -> None:
    from stimrig.rig.control.memory import LatchFile
    from tests.simulator.virtual_time import VirtualMachine

    def read(folder: Path) -> tuple[str | None, str]:
        there = VirtualMachine()
        return there.run(LatchFile(folder, there).read())

    (machine.rig / "latch.json").write_text('{"state": "running", "reason": "test t3"}')
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    assert read(restored(machine, kept, tmp_path).rig) == ("running", "test t3")
    (machine.rig / "latch.json").unlink()
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    restore(kept, machine.rig, machine.api, force=True)
    assert read(machine.rig)[0] == "latched"


def test_a_backup_while_the_service_writes_is_one_state(machine: Machine, tmp_path: Path) -> None:
    """Two numbers that are always changed together stay together, and recordings that come meanwhile do no harm."""
    end = threading.Event()

    def write() -> None:
        number = 0
        while not end.is_set():
            number += 1
            with machine.database() as database:
                database.execute("UPDATE pairs SET a = ?", (number,))
                database.execute("UPDATE pairs SET b = ?", (number,))
            if number % 20 == 0:
                machine.record(machine.rig / "recordings" / f"20260101T1{number:05}Z_w{number}.h5", b"w" * number)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        kept = [backup.create(machine.rig, machine.api, tmp_path / "backups") for _ in range(5)]
    finally:
        end.set()
        writer.join()
    for path in kept:
        backup.check(path)
        with closing(sqlite3.connect(path / DATABASE)) as database:
            a, b = database.execute("SELECT a, b FROM pairs").fetchone()
        assert a == b
    assert a > 0


def test_a_test_that_ended_during_the_backup_is_restored_once(machine: Machine, tmp_path: Path) -> None:
    machine.record(machine.rig / "recordings" / "20260101T100000Z_t3.h5", b"sealed")
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    assert (kept / "rig/journals/t3.journal").exists()
    new = restored(machine, kept, tmp_path)
    assert not (new.rig / "journals" / "t3.journal").exists()
    assert (new.rig / "recordings" / "20260101T100000Z_t3.h5").exists()


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda kept: (kept / "rig/recordings/20260101T080000Z_t1.h5").write_bytes(b"First" * 1000), "changed"),
        (lambda kept: (kept / "rig/recordings/20260101T080000Z_t1.h5").unlink(), "missing"),
        (lambda kept: (kept / "rig/recordings/more.h5").write_bytes(b""), "unknown"),
        (lambda kept: (kept / "manifest.json").unlink(), "no manifest"),
        (lambda kept: (kept / "manifest.json").write_text("{"), "cannot be read"),
        (lambda kept: (kept / "manifest.json").write_text('{"sha256": {}}'), "format"),
        (
            lambda kept: (kept / "manifest.json").write_text(
                (kept / "manifest.json").read_text().replace("rig/journals/t3", "../t3")
            ),
            "outside",
        ),
    ],
)
def test_a_damaged_backup_is_not_restored(machine: Machine, tmp_path: Path, spoil, told: str) -> None:
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    before = machine.contents()
    spoil(kept)
    with pytest.raises(BackupError, match=told):
        restore(kept, machine.rig, machine.api, force=True)
    assert machine.contents() == before


def test_a_recording_that_the_database_names_but_is_not_there_is_told(machine: Machine, tmp_path: Path) -> None:
    (machine.rig / "recordings" / "20260101T080000Z_t1.h5").write_bytes(b"bit rot")
    with pytest.raises(BackupError, match=r"t1\.h5 differs"):
        backup.create(machine.rig, machine.api, tmp_path / "backups")
    (machine.rig / "recordings" / "20260101T080000Z_t1.h5").unlink()
    with pytest.raises(BackupError, match=r"t1\.h5 is not in the backup"):
        backup.create(machine.rig, machine.api, tmp_path / "backups")
    assert all(path.suffix == ".partial" for path in (tmp_path / "backups").iterdir())


def test_what_is_there_is_not_overwritten(machine: Machine, tmp_path: Path) -> None:
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    later = machine.rig / "recordings" / "20260102T080000Z_later.h5"
    machine.record(later, b"made after the backup")
    before = machine.contents()
    with pytest.raises(BackupError, match="--force"):
        restore(kept, machine.rig, machine.api, force=False)
    assert machine.contents() == before
    assert not (machine.rig / "rig.lock").exists()  # it would belong to the one who restores, and keep the rig out
    words = restore(kept, machine.rig, machine.api, force=True).words
    assert not later.exists()
    [aside] = machine.rig.parent.glob("rig.before-*")
    assert (aside / "recordings" / later.name).read_bytes() == b"made after the backup"
    assert any(str(aside) in line for line in words)


def test_nothing_is_restored_under_a_running_rig_or_service(machine: Machine, tmp_path: Path) -> None:
    kept = backup.create(machine.rig, machine.api, tmp_path / "backups")
    with (machine.rig / "rig.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BackupError, match="a rig runs"):
            restore(kept, machine.rig, machine.api, force=True)
    with machine.database(), pytest.raises(BackupError, match="a service uses it"):
        restore(kept, machine.rig, machine.api, force=True)


def test_one_folder_for_both(machine: Machine, tmp_path: Path) -> None:
    """As `stimrig serve` keeps them."""
    with machine.database() as database:
        database.execute("DELETE FROM recordings WHERE path LIKE '%upload%'")
    (machine.api / "stimrig.db").rename(machine.rig / "stimrig.db")
    kept = backup.create(machine.rig, machine.rig, tmp_path / "backups")
    restore(kept, tmp_path / "var", tmp_path / "var", force=False)
    assert (tmp_path / "var" / "stimrig.db").exists()
    assert (tmp_path / "var" / "recordings" / "20260101T080000Z_t1.h5").read_bytes() == b"first" * 1000


def test_no_room_is_told_before_anything_is_written(machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(copying.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(BackupError, match="0 MB free"):
        backup.create(machine.rig, machine.api, tmp_path / "backups")
    assert list((tmp_path / "backups").iterdir()) == []


def test_the_command_line(machine: Machine, tmp_path: Path) -> None:
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*STIMRIG, *arguments], capture_output=True, text=True)

    folders = ["--rig-data", str(machine.rig), "--data", str(machine.api)]
    made = call("create", *folders, "--to", str(tmp_path / "backups"), "--json")
    assert made.returncode == 0, made.stderr
    kept = json.loads(made.stdout)["backup"]
    looked = call("verify", kept)  # what stands for recordings here is no HDF5
    assert (looked.returncode, len(looked.stderr.splitlines())) == (1, 1) and "cannot be opened" in looked.stderr
    refused = call("restore", *folders, kept)
    assert (refused.returncode, len(refused.stderr.splitlines())) == (1, 1)
    assert call("restore", *folders, "--force", kept).returncode == 0
    absent = call("create", "--data", str(tmp_path / "nowhere"), "--to", str(tmp_path / "b"))
    assert absent.returncode == 2
    assert "no database" in absent.stderr


@pytest.mark.parametrize("latch", [b"", b"\xff", b"[]", b"{}", b"3", b"[" * 100_000])
def test_a_latch_that_cannot_be_read_is_no_hindrance_and_is_told(machine: Machine, tmp_path: Path, latch: bytes):
    (machine.rig / "latch.json").write_bytes(latch)
    made = backup.create(machine.rig, machine.api, tmp_path / "backups")
    rig, api = tmp_path / "new" / "rig", tmp_path / "new" / "api"
    restore(made, rig, api, force=False)
    found = json.loads((rig / "latch.json").read_text())
    assert found["state"] == "latched" and "its latch could not be read" in found["reason"]


@pytest.mark.parametrize("content", ['{"format": 1, "sha256": []}', "[]", "3", "[" * 100_000, '{"sha256": {"a": 1}}'])
def test_a_manifest_of_nonsense_is_told_in_one_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "manifest.json").write_text(content)
    done = subprocess.run([*STIMRIG, "verify", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode in (1, 2) and len(done.stderr.splitlines()) == 1, done.stderr
