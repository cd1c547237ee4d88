"""A backup is consistent while service and rig write, checked, and comes up latched where it is restored."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import threading
from contextlib import closing
from pathlib import Path

import pytest

from stimrig.api.cli import main
from stimrig.api.cli.commands import backup
from stimrig.api.store import Store
from stimrig.api.store.tables import Participant, Recording
from stimrig.api.whole_file import sha256_of
from stimrig.rig.control.memory import LatchFile
from tests.api.test_schemas import unmet
from tests.simulator.virtual_time import VirtualMachine


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
