"""`stimrig backup verify`: a backup is restored for trial, and whatever is wrong with it is told."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import h5py
import pytest

import stimrig
from stimrig.api.cli import main
from stimrig.api.operation import backup, drill, state
from stimrig.api.operation.copying import DATABASE, MANIFEST, BackupError
from stimrig.api.store import Store
from stimrig.api.store.tables import Model, Participant, Recording
from tests.api.test_worker import made_up_csv

NOW = "2026-01-01T08:00:00.000Z"


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("drill")
    model = stimrig.fit(stimrig.read(made_up_csv(folder / "record.csv")))
    return stimrig.save(model, folder / "MODEL.json").read_bytes()


@pytest.fixture
def kept(tmp_path: Path, document: bytes) -> Path:
    """A backup of two recordings and a model."""
    rig, api = tmp_path / "lib" / "rig", tmp_path / "lib" / "api"
    for folder in (rig / "journals", rig / "recordings", api / "recordings"):
        folder.mkdir(parents=True)
    with h5py.File(rig / "recordings" / "20260101T080000Z_t1.h5", "w") as file:
        file["torque/torque_nm"] = [0.0, 1.0]
    (api / "recordings" / "upload-aa.csv").write_text("time_s,torque_nm\n")
    store = Store(f"sqlite:///{api / 'stimrig.db'}")
    with store.write() as session:
        session.add(Participant(code="P017", profile={}, created_utc=NOW, created_by="a"))
        session.flush()
        for name, path in (("r1", rig / "recordings/20260101T080000Z_t1.h5"), ("r2", api / "recordings/upload-aa.csv")):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            session.add(Recording(id=name, participant="P017", path=str(path), file_sha256=digest, created_utc=NOW))
        session.flush()
        etag = hashlib.sha256(document).hexdigest()
        session.add(
            Model(id="m1", participant="P017", recording_id="r1", method="maximum-likelihood", document=document,
                  etag=etag, created_utc=NOW, created_by="a")
        )  # fmt: skip
    store.close()
    return backup.create(rig, api, tmp_path / "backups")


def seal(kept: Path) -> None:
    """Let the manifest agree with what stands there now: only the drill can see what is wrong."""
    told = json.loads((kept / MANIFEST).read_text())
    told["sha256"] = {name: hashlib.sha256((kept / name).read_bytes()).hexdigest() for name in told["sha256"]}
    (kept / MANIFEST).write_text(json.dumps(told))


def test_a_sound_backup_is_restored_compared_and_removed(kept: Path) -> None:
    shares: list[float] = []
    found = drill.verify(kept, tell=lambda share, _text: shares.append(share))
    assert (found.files_same, found.recordings, found.models, found.rows_compared) == (3, 2, 1, True)
    assert found.rows > 4
    assert shares == sorted(shares) and len(shares) > 6 and shares[-1] < 1.0
    assert list(kept.parent.iterdir()) == [kept]


def change(statement: str, *values: object) -> Callable[[Path], None]:
    def spoil(kept: Path) -> None:
        with closing(sqlite3.connect(kept / DATABASE)) as database, database:
            database.execute(statement, values)
        seal(kept)

    return spoil


def no_hdf5(kept: Path) -> None:
    path = kept / "rig/recordings/20260101T080000Z_t1.h5"
    path.write_bytes(b"nothing that opens")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    change("UPDATE recordings SET file_sha256 = ? WHERE id = 'r1'", digest)(kept)


def no_model(kept: Path) -> None:
    etag = hashlib.sha256(b"{}").hexdigest()
    change("UPDATE models SET document = ?, etag = ?", b"{}", etag)(kept)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (change("DELETE FROM models"), "models: 0 rows, the backup had 1"),
        (change("UPDATE models SET etag = 'other'"), "model m1: cannot be read"),
        (no_model, "model m1: cannot be read"),
        (change("UPDATE recordings SET path = '/x/gone.h5' WHERE id = 'r1'"), "gone.h5 is not in the backup"),
        (change("UPDATE recordings SET file_sha256 = 'other' WHERE id = 'r2'"), "upload-aa.csv differs"),
        (no_hdf5, "t1.h5: cannot be opened"),
        (lambda kept: (kept / "api/recordings/upload-aa.csv").write_bytes(b"x"), "changed: api/recordings"),
    ],
)
def test_a_backup_of_no_use_is_told(kept: Path, spoil: Callable[[Path], None], told: str) -> None:
    spoil(kept)
    with pytest.raises(BackupError, match=told):
        drill.verify(kept)
    assert list(kept.parent.iterdir()) == [kept]


def test_a_backup_from_before_rows_were_counted_is_verified_and_says_so(kept: Path) -> None:
    told = json.loads((kept / MANIFEST).read_text())
    del told["rows"]
    (kept / MANIFEST).write_text(json.dumps(told))
    assert not drill.verify(kept).rows_compared


def test_the_result_is_kept_beside_the_database(kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    api = tmp_path / "lib" / "api"
    assert main.run(["backup", "verify", str(kept), "--data", str(api)]) == 0
    assert "2 recordings opened, 1 models read" in capsys.readouterr().out
    good = state.read(api)
    assert good.verified_unix_s > 0 and good.verified_of_utc and not good.problem
    change("DELETE FROM models")(kept)
    assert main.run(["backup", "verify", str(kept), "--data", str(api)]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
    bad = state.read(api)
    assert "models: 0 rows" in bad.problem and bad.verified_utc == good.verified_utc
    assert main.run(["backup", "verify", str(tmp_path), "--data", str(api)]) == 2
    assert state.read(api) == bad, "nothing was tried"
    assert main.run(["backup", "verify", str(kept), "--place", str(tmp_path / "nowhere")]) == 1
    assert state.read(tmp_path / "nowhere") == state.Backups()


def test_the_verb_makes_and_puts_back(kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = ["--rig-data", str(tmp_path / "lib/rig"), "--data", str(tmp_path / "lib/api")]
    assert main.run(["backup", "create", *folders, "--to", str(tmp_path / "other"), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["files"] == 3 and Path(made["backup"]).is_dir()
    assert state.read(tmp_path / "lib/api").created_bytes == made["bytes"]
    assert main.run(["backup", "restore", made["backup"], *folders]) == 1
    assert main.run(["backup", "restore", made["backup"], *folders, "--force", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["restored"]) == 4


@pytest.mark.parametrize("content", ["", "[]", "{", '{"created_utc": 3}', '{"other": 1}', "[" * 100_000])
def test_a_state_of_nonsense_is_none(tmp_path: Path, content: str) -> None:
    (tmp_path / state.STATE).write_text(content)
    assert state.read(tmp_path) == state.Backups()
