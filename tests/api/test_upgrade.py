"""`stimrig upgrade`: to this version and back; what is between them is whole and old, or whole and new."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from stimrig.api.cli import main
from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store import Store, copies, downgrades, migrations
from stimrig.api.store.holds import HeldError, ServiceLock
from stimrig.api.store.tables import Approval, Model, Participant
from stimrig.api.upgrade import Request, UpgradeError, places, upgrade
from stimrig.rig.config import RigConfig
from tests.api.test_schemas import unmet
from tests.harness import upgrades
from tests.harness.postgres import Cluster
from tests.harness.upgrades import lost_between, make_old, make_since, rows_of

pytestmark = pytest.mark.sqlite
ROOT = Path(__file__).parents[2]
OLD_SETTINGS = {
    f"STIMRIG_{name.upper()}"
    for name in (
        "data_dir", "database_url", "host", "port", "admin_token", "rig_socket", "rig_file", "emulated", "rig_name",
        "workers", "session_hours", "idle_lock_min", "time_zone", "secure_cookies", "tls_proxy", "max_upload_mb",
        "lsl", "effects_dir", "structure", "centre_url", "centre_key",
    )
}  # fmt: skip
OLD_RIG_KEYS = {
    "data_dir", "socket", "clock_speed", "require_calibration", "stimulator", "load_cell", "angle_sensor", "limits",
    "watch",
}  # fmt: skip


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data folder of version 0.1, with two people and three recordings of theirs."""
    make_old(tmp_path / "data", 2, 3)
    return tmp_path / "data"


def run(data: Path, **asked: Any) -> dict[str, Any]:
    return upgrade(Settings(data_dir=data, database_url=None), Request(**asked), Clock())


def revision(data: Path) -> str:
    with closing(sqlite3.connect(data / "stimrig.db")) as database:
        return database.execute("SELECT version_num FROM alembic_version").fetchone()[0]


def schema(data: Path) -> set[str]:
    with closing(sqlite3.connect(data / "stimrig.db")) as database:
        found = database.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name != 'set_aside'")
        return {" ".join(row[0].split()) for row in found}


def test_back_is_the_old_schema_and_keeps_what_was_made_since(data: Path) -> None:
    old, before = schema(data), rows_of(data)
    up = run(data)
    assert (up["from"], up["to"], up["doubts"]) == ("0012", migrations.NEWEST, [])
    make_since(data, 0, new=True)
    since = rows_of(data)
    back = run(data, back=True)
    assert revision(data) == "0012" and schema(data) == old
    with closing(sqlite3.connect(data / "stimrig.db")) as database:
        people = dict(database.execute("SELECT code, profile FROM participants").fetchall())
    assert "N0" in people and json.loads(people["N0"]) == {"current_ma": 18.0}, "as version 0.1 knows a profile"
    assert any("search for an electrode" in line for line in back["told"])
    assert lost_between(before, rows_of(data)) == lost_between(since, rows_of(data)) == []
    make_since(data, 1, new=False)
    both = rows_of(data)
    run(data)
    assert lost_between(both, rows_of(data)) == [] and {"N0", "O1"} <= {row["code"] for row in people_of(data)}
    assert {row["code"]: row["placement"] for row in people_of(data)}["N0"] == "2 cm distal"


def people_of(data: Path) -> list[dict[str, Any]]:
    return list(rows_of(data)["participants"].values())


def test_every_revision_since_has_its_way_back() -> None:
    assert set(downgrades.STEPS) == {one for one in migrations.STEPS if one > downgrades.OLDEST}


def test_the_copy_is_the_database_as_it_was_and_the_entry_fits(data: Path) -> None:
    before = rows_of(data)
    copy = Path(run(data)["copy"])
    assert copy.parent.name == migrations.BEFORE and copy.stat().st_mode & 0o077 == 0
    shutil.rmtree(data.parent / "restored", ignore_errors=True)
    (data.parent / "restored/recordings").mkdir(parents=True)
    shutil.copy(copy, data.parent / "restored/stimrig.db")
    was = rows_of(data.parent / "restored")
    assert {name: was[name] for name in was if name != "files"} == {
        name: before[name] for name in was if name != "files"
    }
    audit = list(rows_of(data)["audit"].values())
    assert audit[-1]["action"] == "upgrade" and audit[-1]["subject"] == f"0012 to {migrations.NEWEST}"
    assert run(data)["copy"] is None and len(rows_of(data)["audit"]) == len(audit), "a second call does nothing"


def test_a_dry_run_says_the_same_and_changes_nothing_also_while_a_service_runs(data: Path) -> None:
    run(data)
    make_since(data, 0, new=True)
    before, listed = rows_of(data), sorted(path.name for path in data.rglob("*"))
    lock = ServiceLock(Settings(data_dir=data, database_url=None))
    said = run(data, back=True, dry_run=True)
    lock.release()
    assert rows_of(data) == before and set(listed) >= {path.name for path in data.rglob("*")} - {"service.lock"} - {
        "stimrig.db.lock", "stimrig.db-wal", "stimrig.db-shm"}  # fmt: skip
    assert said["told"] == run(data, back=True)["told"] and len(said["told"]) > 3


def test_approvals_end_and_models_of_several_muscles_are_not_served_by_the_old_version(data: Path) -> None:
    """Version 0.1 knows no sites, and takes a file whose hash differs for damaged."""
    run(data)
    document = b'{"schema_version": "1.0", "kind": "joint"}'
    with closing(sqlite3.connect(data / "stimrig.db")) as database, database:
        database.execute("UPDATE approvals SET expires_utc = '2999-01-01T00:00:00.000Z' WHERE model_id = 'Mx0'")
        database.execute("UPDATE models SET document = ?, etag = 'its hash' WHERE id = 'Mx1'", (document,))
    run(data, back=True)
    rows = rows_of(data)
    assert all(row["expires_utc"] < Clock().utc() for row in rows["approvals"].values() if row["approved"])
    with closing(sqlite3.connect(data / "stimrig.db")) as database:
        assert database.execute("SELECT etag FROM models WHERE id = 'Mx1'").fetchone() == ("set aside Mx1",)
    run(data)
    with closing(Store(f"sqlite:///{data}/stimrig.db")) as store:
        assert store.get(Model, "Mx1").etag == "its hash"
        ended = store.first(Approval, Approval.model_id == "Mx0")
        assert ended.expires_utc < Clock().utc(), "what ended does not come into force again"


def test_a_placement_stays_aside_where_the_old_version_was_told_of_another_muscle(data: Path) -> None:
    run(data)
    make_since(data, 0, new=True)
    run(data, back=True)
    with closing(sqlite3.connect(data / "stimrig.db")) as database, database:
        database.execute("UPDATE participants SET muscle = 'triceps brachii' WHERE code = 'N0'")
    told = run(data)["told"]
    assert told == [
        "1 × placement of a participant's electrodes. It stays aside: what it belongs to was changed since."
    ]
    with closing(Store(f"sqlite:///{data}/stimrig.db")) as store:
        assert store.get(Participant, "N0").placement is None


# ---- killed, and held


def test_an_error_at_each_step_leaves_the_old_or_the_new_state(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, broken = rows_of(data), ("0013", "0014", "0015", "0016")

    def fail(*_: object) -> None:
        raise OperationalError("", {}, Exception("disk I/O error"))

    for steps, back in ((migrations.STEPS, False), (downgrades.STEPS, True)):
        for name in broken:
            with monkeypatch.context() as patch:
                patch.setitem(steps, name, fail)
                at = revision(data)
                with pytest.raises(UpgradeError, match="disk I/O error"):
                    run(data, back=back)
            assert revision(data) == at and upgrades.half(data) == [] and lost_between(before, rows_of(data)) == []
        run(data, back=back)
        assert (revision(data) == "0012") == back and not (data / "upgrade.json").exists()


@pytest.mark.slow
def test_killed_before_any_statement_nothing_is_lost_or_half(tmp_path: Path) -> None:
    """In a process of its own: it forks."""
    words = "import json, pathlib, sys; from tests.harness.upgrades import campaign; "
    words += "print(json.dumps(campaign(pathlib.Path(sys.argv[1]), 2, 2, 6, True)))"
    done = subprocess.run(
        [sys.executable, "-c", words, str(tmp_path / "data")], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["killed"] == {"upgrade": 6, "back": 6} and found["lost"] == found["half"] == [] and found["whole"]


def test_the_measure_finds_what_is_lost_and_what_is_half(data: Path) -> None:
    run(data)
    before = rows_of(data)
    with closing(sqlite3.connect(data / "stimrig.db")) as database, database:
        database.execute("DELETE FROM approvals WHERE model_id = 'Mx0'")
        database.execute("ALTER TABLE participants DROP COLUMN placement")
    assert any("approvals" in line for line in lost_between(before, rows_of(data)))
    assert any("participants" in line for line in upgrades.half(data))


def test_nobody_starts_meanwhile_and_it_does_not_start_while_somebody_runs(data: Path) -> None:
    settings = Settings(data_dir=data, database_url=None)
    seen: list[str] = []

    def tell(_share: float, _text: str) -> None:
        with pytest.raises(HeldError, match="at stimrig upgrade"):
            ServiceLock(settings)
        with (data / "rig.lock").open("a+") as file, pytest.raises(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        seen.append((data / "rig.lock").read_text())

    upgrade(settings, Request(), Clock(), tell)
    assert seen and all(line == f"{os.getpid()}, stimrig upgrade" for line in seen)
    lock = ServiceLock(settings)
    with pytest.raises(UpgradeError, match="another service runs on it"):
        run(data, back=True)
    lock.release()
    with (data / "rig.lock").open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(UpgradeError, match=r"a rig .* uses it; stop it first"):
            run(data, back=True)
    assert revision(data) == migrations.NEWEST


def test_a_test_that_is_open_keeps_from_going_back(data: Path) -> None:
    run(data)
    with closing(sqlite3.connect(data / "stimrig.db")) as database, database:
        database.execute("UPDATE tests SET state = 'running'")
    with pytest.raises(UpgradeError, match="a test is still open"):
        run(data, back=True)
    (data / "journals").mkdir()
    (data / "journals/T1.journal").write_bytes(b"x")
    with pytest.raises(UpgradeError, match=r"T1\.journal: a test that was cut short"):
        run(data, back=True)
    assert revision(data) == migrations.NEWEST


def test_a_service_makes_a_copy_before_it_upgrades_by_itself(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> str:
        raise copies.CopyError("no space left; free some disk space")

    with monkeypatch.context() as patch:
        patch.setattr(copies, "copy_database", full)
        with pytest.raises(Exception, match="is upgraded only with a copy: no space left"):
            Store(f"sqlite:///{data}/stimrig.db")
    assert revision(data) == "0012"
    Store(f"sqlite:///{data}/stimrig.db").close()
    assert [path.name for path in (data / migrations.BEFORE).iterdir()] == ["stimrig-0012-1.db"]


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: folders of two users")
def test_root_upgrades_the_folders_of_two_users_and_what_is_made_is_theirs() -> None:
    """As the package lays them out: a rig's folder and a service's, and a recording that only the unit sees in both."""
    with tempfile.TemporaryDirectory() as place:
        api, rig = Path(place) / "api", Path(place) / "rig"
        make_old(api, 2, 3)
        (rig / "recordings").mkdir(parents=True)
        Path(place).chmod(0o755)
        (api / "recordings/x1.h5").rename(rig / "recordings/x1.h5")
        for folder, user in ((api, 5001), (rig, 5002)):
            for path in (folder, *folder.rglob("*")):
                os.chown(path, user, 5000)
                path.chmod(0o750 if path.is_dir() else 0o640)
        assert run(api, rig_data=rig)["doubts"] == []
        assert run(api, rig_data=rig, back=True)["doubts"] == []
        assert {path.stat().st_uid for path in (api, *api.rglob("*"))} == {5001}
        assert (rig / "rig.lock").stat().st_uid == 5002 and os.geteuid() == 0


def test_a_recording_whose_file_a_rule_took_is_no_doubt(data: Path) -> None:
    run(data)
    with closing(sqlite3.connect(data / "stimrig.db")) as database, database:
        database.execute("UPDATE recordings SET path = '' WHERE id = 'x1'")
    (data / "recordings/x1.h5").unlink()
    assert run(data, back=True)["doubts"] == []


# ---- the verb


def test_the_way_back_names_every_key_and_setting_that_is_new() -> None:
    """`OLD_…`: those of c6ff60e."""
    names = {f"STIMRIG_{name.upper()}" for name in Settings.model_fields}
    assert {name for name in names if not name.startswith(places.NEW_SETTINGS)} == OLD_SETTINGS
    assert RigConfig.model_fields.keys() - OLD_RIG_KEYS == {key for key in places.NEW_RIG_KEYS if "." not in key}


def test_the_verb(data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    rig = data / "rig.toml"
    rig.write_text('[switch]\ndevice = "scpi_matrix"\n[stimulator]\ndevice = "p24"\nchannels = []\n')
    monkeypatch.setenv("STIMRIG_HEADS_FILE", "/heads")
    assert main.run(["upgrade", "--data", str(data), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == {"from", "to", "dry_run", "copy", "told", "doubts", "notes"}
    assert unmet("upgrade", found) == []
    assert main.run(["upgrade", "--data", str(data), "--back", "--rig", str(rig)]) == 0
    said = capsys.readouterr().out
    assert "switch: version 0.1 refuses this key" in said and "stimulator.channels" in said and "HEADS_FILE" in said
    (data / "recordings/x1.h5").write_bytes(b"other")
    assert main.run(["upgrade", "--data", str(data)]) == 1
    assert "x1.h5 differs from what the database says" in capsys.readouterr().out
    assert main.run(["upgrade", "--data", str(data)]) == 0
    assert capsys.readouterr().out == f"the data are at {migrations.NEWEST} already\n"
    assert main.run(["upgrade", "--data", str(data / "nowhere")]) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and "no such folder" in printed.err and printed.out == ""


def test_postgresql_goes_up_and_back_too(cluster: Cluster, tmp_path: Path) -> None:
    """What an upgraded one holds is the same after the way back and another upgrade."""
    url = cluster.database(str(tmp_path / "upgrade"))
    settings = Settings(data_dir=tmp_path, database_url=url)
    with closing(Store(url)) as store, store.write() as session:
        profile = {"current_ma": 18.0, "angle_set_at_utc": "2026-11-23T10:00:00.000Z"}
        person = Participant(code="P1", profile=profile, created_utc="x", created_by="Ada", placement="2 cm distal")
        person.channels = {"triceps": {"muscle": "triceps brachii"}}
        session.add(person)
    with pytest.raises(UpgradeError, match="pg_dump"):
        upgrade(settings, Request(back=True), Clock())
    back = upgrade(settings, Request(back=True, copied=True), Clock())
    assert len(back["told"]) == 3 and back["to"] == "0012"
    assert upgrade(settings, Request(copied=True), Clock())["doubts"] == []
    with closing(Store(url)) as store:
        row = store.get(Participant, "P1")
        assert (row.placement, row.profile, row.channels) == ("2 cm distal", profile, person.channels)
