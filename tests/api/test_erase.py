"""`stimrig erase`: a participant goes to the last byte, what is others' stays, and the audit trail is whole."""

from __future__ import annotations

import hashlib
import json
import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import typer
from sqlalchemy import update

from stimrig.api.cli import main
from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit, copies, migrations
from stimrig.api.store.tables import Approval, AuditEntry, Model, Participant, Recording, Test, Token
from tests.api.conftest import STUB, put_database, run_test, serving
from tests.api.test_schemas import unmet

CODE = "XQ7ZZ81"
LONG_AGO = "2020-01-01T00:00:00.000Z"


class Rig:
    """A rig's data folder, and what was written into it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.chance, self.number = folder, random.Random(1), 0
        (folder / "recordings").mkdir(parents=True, exist_ok=True)
        put_database(folder)
        self.store = Store(Settings(data_dir=folder).database)

    @property
    def now(self) -> str:
        return Clock().utc()

    def add(self, *rows: Any, action: str = "", subject: str = "x") -> None:
        """Write rows, and an audit entry, in one transaction."""
        with self.store.write() as session:
            for row in rows:
                session.add(row)
                session.flush()
            if action:
                audit.write(session, self.now, "Ada", action, subject)

    def begin_test(self, code: str) -> str:
        if self.store.get(Participant, code) is None:
            row = Participant(code=code, profile={"current_ma": 20.0}, created_utc=self.now, created_by="Ada")
            self.add(row, action="create participant", subject=code)
        self.number += 1
        plan = {"kind": "identification", "preview": {"duration_s": 30.0, "pulse_width_us": [1.0] * 1000}}
        row = Test(id=f"T{self.number}", participant=code, kind="identification", state="requested", plan=plan)
        row.summary, row.reason, row.requested_by, row.requested_utc = {}, "", "Ada", self.now
        self.add(row, action="start test", subject=row.id)
        return row.id

    def session(self, code: str) -> Model:
        """A test with its recording, its model and a decision on it."""
        test_id, number = self.begin_test(code), self.number
        data, path = self.chance.randbytes(1000), self.folder / "recordings" / f"R{number}.h5"
        path.write_bytes(data)
        recording = Recording(id=f"R{number}", participant=code, test_id=test_id, path=str(path), origin="rig")
        recording.file_sha256, recording.created_utc = hashlib.sha256(data).hexdigest(), self.now
        self.add(recording, action="record", subject=recording.id)
        document = json.dumps({"model_id": f"M{number}", "noise": self.chance.random()}).encode()
        model = Model(id=f"M{number}", participant=code, recording_id=recording.id, method="ml", document=document)
        model.effects, model.fit, model.etag = ["fatigue"], {"fit_percent": 97.0}, hashlib.sha256(document).hexdigest()
        model.created_utc, model.created_by = self.now, "test"
        self.add(model, action="store model", subject=model.id)
        with self.store.write() as session:
            row = session.get_one(Test, test_id)
            row.state, row.recording_id, row.model_id, row.finished_utc = "completed", recording.id, model.id, self.now
        decision = Approval(model_id=model.id, participant=code, approved=True, reason="P. said it felt fine", by="Ada")
        decision.at_utc = self.now
        self.add(decision, action="approve", subject=model.id)
        return model


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.store.close()


def play_sessions(rig: Rig, code: str, sessions: int = 2) -> None:
    """Sessions of days that are over: no model of theirs is in use."""
    for _ in range(sessions):
        rig.session(code)
    with rig.store.write() as session:
        session.execute(update(Approval).where(Approval.participant == code).values(expires_utc=LONG_AGO))


def erase(rig: Rig, code: str, *more: str) -> int:
    return main.run(["erase", code, "--yes", "--data", str(rig.folder), *more])


def files_with(folder: Path, text: str) -> list[str]:
    """Files below a folder that have this text in them, or in their names."""
    found = [path for path in folder.rglob("*") if path.is_file()]
    return [path.name for path in found if text in path.name or text.encode() in path.read_bytes()]


def trail(rig: Rig) -> list[AuditEntry]:
    return rig.store.all(AuditEntry, order=AuditEntry.seq)


def test_nothing_of_a_person_stays_and_nothing_of_others_goes(tmp_path: Path, short_dir: Path) -> None:
    """Everything that the pages write of a participant, on a real service; then every byte is read."""
    tests: dict[str, Any] = {}
    with serving(tmp_path, short_dir, STUB) as (_, http):
        for code in ("P1", CODE):
            http.post("/v1/participants", json={"code": code, "side": "left", "muscle": "biceps"})
            test = tests[code] = run_test(http, code)
            note = {"kind": "other", "text": f"said that {code} slept badly", "test_id": test["id"]}
            assert http.post(f"/v1/participants/{code}/notes", json=note).status_code == 201
            assert http.post(f"{test['model_url']}/approve", json={"reason": f"{code} is well"}).status_code == 200
            key = {"name": "ilc", "current_ma": 8, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}
            assert http.post(f"/v1/participants/{code}/keys", json=key).status_code == 201
            assert http.get(f"{test['model_url']}/diagnosis?wait=false").is_success
        kept = http.get("/v1/participants/P1/model").json()
        recording = http.get(tests["P1"]["recording_url"]).content
        before = [entry["hash"] for entry in http.get("/v1/audit").json()["entries"]]
        words = ["erase", CODE, "--data", str(tmp_path), "--yes"]
        assert main.run(words) == 2, "a service runs"
    assert main.run(words) == 2, "a controller may use the model today"
    with serving(tmp_path, short_dir, STUB) as (service, http):
        reject = http.post(f"{tests[CODE]['model_url']}/reject", json={"reason": "asked to be erased"})
        assert reject.status_code == 200, reject.text
        service.sql(f"UPDATE tokens SET expires_utc = '{LONG_AGO}' WHERE participant = '{CODE}'")
    copies.copy_database(tmp_path / "stimrig.db", tmp_path / migrations.BEFORE / "stimrig-0001.db")
    assert {"stimrig.db", "stimrig-0001.db"} <= set(files_with(tmp_path, CODE))
    assert main.run(words) == 0
    assert files_with(tmp_path, CODE) == [] and files_with(tmp_path, tests[CODE]["id"]) == []
    assert main.run(["audit", "verify", "--data", str(tmp_path)]) == 0
    with serving(tmp_path, short_dir, STUB) as (_, http):
        assert http.get(f"/v1/participants/{CODE}").status_code == 404
        assert http.get("/v1/participants/P1/model").json() == kept
        assert http.get(tests["P1"]["recording_url"]).content == recording
        found = http.get("/v1/audit").json()
        assert found["whole"] and [entry["hash"] for entry in found["entries"]][: len(before)] == before
        assert http.get("/administration").status_code == 200
        blank = [entry for entry in found["entries"] if entry["subject"] == audit.ERASED]
        assert len(blank) >= 6 and {"approve", "set profile"} & {entry["action"] for entry in blank}
        assert http.post("/v1/participants", json={"code": CODE}).status_code == 201, "a code that is free again"


@pytest.mark.parametrize("code", ["scopes", "read-model", "anna", "tests", "kept", "reason", "a"])
def test_a_code_that_is_a_word_of_the_trail_or_a_users_name_takes_nothing_of_others(rig: Rig, code: str) -> None:
    with rig.store.write() as session:
        for subject in ("anna", "Ada"):
            audit.write(session, LONG_AGO, "administrator", "add user", subject, scopes=["read-model"])
    play_sessions(rig, "P1", 1)
    play_sessions(rig, code, 1)
    assert erase(rig, "P1", "--reason", "12") == 0 and erase(rig, code, "--reason", "12") == 0
    assert {entry.who for entry in trail(rig) if entry.action == "approve"} == {"Ada"}
    assert [entry.action for entry in trail(rig) if entry.subject != audit.ERASED][-2:] == [audit.ERASE] * 2
    users = [entry for entry in trail(rig) if entry.action == "add user"]
    assert [entry.subject for entry in users] == ["anna", "Ada"]
    assert audit.first_broken(trail(rig)) is None and files_with(rig.folder / "recordings", "") == []


def test_it_asks_before_and_says_what_it_did(
    rig: Rig, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    play_sessions(rig, "P1")
    words = ["erase", "P1", "--data", str(rig.folder)]
    assert main.run(words) == 2 and "--yes" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", Mock(side_effect=typer.Abort))
    assert main.run(words) == 130 and rig.store.get(Participant, "P1") is not None
    assert erase(rig, "P1", "--reason", "P1 has died") == 2 and "--reason" in capsys.readouterr().err
    assert len(files_with(rig.folder / "recordings", "")) == 2
    assert erase(rig, "P1", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found == {"rows": {"participants": 1, "tests": 2, "recordings": 2, "models": 2, "approvals": 2}, "files": 2}
    assert unmet("erase", found) == []
    assert erase(rig, "P1") == 2 and "there is no participant" in capsys.readouterr().err
    assert erase(rig, "") == 2 and "there is no participant" in capsys.readouterr().err


def test_refused_while_a_test_goes_on_or_a_controller_may_use_a_model(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    play_sessions(rig, "P1")
    test = rig.begin_test("P2")
    assert erase(rig, "P1") == 2 and f"Test {test} is requested" in capsys.readouterr().err
    with rig.store.write() as session:
        session.execute(update(Test).where(Test.id == test).values(state="completed"))
    rig.add(Token(hash="h" * 64, prefix="k", name="ilc", scopes=["run-test"], created_utc=rig.now, participant="P1"))
    assert erase(rig, "P1") == 2 and "a controller may use" in capsys.readouterr().err
    with rig.store.write() as session:
        session.execute(update(Token).values(revoked=True))
        session.execute(update(Approval).where(Approval.id == 1).values(expires_utc=None))
    assert erase(rig, "P1") == 2 and "a controller may use" in capsys.readouterr().err
    with rig.store.write() as session:
        session.execute(update(Approval).values(expires_utc=LONG_AGO))
    assert erase(rig, "P1") == 0 and rig.store.all(Token) == []
    assert main.run(["erase", "P1", "--yes", "--data", str(tmp_path / "nowhere")]) == 2
    assert not (tmp_path / "nowhere").exists()


def test_the_rigs_own_files_go_too(rig: Rig, tmp_path: Path) -> None:
    """The service sees the rig's recordings in another place; journals of its tests lie beside them."""
    play_sessions(rig, "P1", 1)
    own = tmp_path / "own"
    (kept,) = (rig.folder / "recordings").rglob("*.h5")
    names = ("recordings/20260101T000000Z_T1.h5", "journals/T1.journal", "recordings/20260101T000000Z_T11.h5")
    for name in (*names, f"recordings/deep/{kept.name}"):
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).write_bytes(b"x")
    assert erase(rig, "P1", "--rig-data", str(own)) == 0
    assert [path.name for path in own.rglob("*") if path.is_file()] == ["20260101T000000Z_T11.h5"]
    assert not kept.exists()


def test_a_file_outside_of_the_data_folders_stays(
    rig: Rig, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    """The service writes the database; whoever erases may be root."""
    play_sessions(rig, "P1", 1)
    other = tmp_path_factory.mktemp("elsewhere") / "shadow"
    other.write_text("of another program")
    (rig.folder / "recordings/link").symlink_to(other.parent)
    (rig.folder / "recordings/shadow").symlink_to(other)
    for path in (
        other,
        rig.folder / "recordings/link/shadow",
        rig.folder / "recordings/shadow",
        Path(f"{rig.folder}/../{os.path.relpath(other, rig.folder.parent)}"),
    ):
        with rig.store.write() as session:
            session.execute(update(Recording).values(path=str(path)))
        assert erase(rig, "P1") == 2 and "none of the data folders" in capsys.readouterr().err
        assert other.exists() and rig.store.get(Participant, "P1") is not None, "nothing is half"


def test_cut_off_the_same_command_goes_on(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    play_sessions(rig, "P1")

    def refuse(path: Path, **_: Any) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        assert erase(rig, "P1") == 2 and "Permission denied" in capsys.readouterr().err
    with monkeypatch.context() as patch:
        patch.setattr(audit, "left_of", lambda _: 1 / 0)  # after the files, within the transaction
        assert erase(rig, "P1") != 0
    assert len(rig.store.all(Recording)) == 2 and not list((rig.folder / "recordings").glob("*.h5"))
    assert erase(rig, "P1") == 0 and rig.store.all(Recording) == [] and audit.first_broken(trail(rig)) is None


# ---- the trail


def test_only_what_an_entry_vouches_for_may_be_blank(rig: Rig) -> None:
    play_sessions(rig, "P1", 1)
    play_sessions(rig, "P2", 1)
    assert erase(rig, "P1") == 0
    assert audit.first_broken(trail(rig)) is None
    other = next(entry for entry in trail(rig) if entry.subject == "P2")
    last = trail(rig)[-1].seq
    blank = next(entry for entry in trail(rig) if entry.subject == audit.ERASED)
    for seq, changed in (
        (other.seq, {"subject": audit.ERASED, "detail": {"erased": last}}),  # one more than was vouched for
        (blank.seq, {"who": "Eve"}),
        (blank.seq, {"at_utc": LONG_AGO}),
        (blank.seq, {"detail": {"erased": last, "more": 1}}),
        (last, {"who": "Eve"}),
        (last, {"detail": {"entries": 0, "kept": audit.left_of([])}}),
    ):
        before = next(entry for entry in trail(rig) if entry.seq == seq).as_dict()
        with rig.store.write() as session:
            session.execute(update(AuditEntry).where(AuditEntry.seq == seq).values(**changed))
        assert audit.first_broken(trail(rig)) in (seq, blank.seq), changed
        with rig.store.write() as session:
            session.execute(update(AuditEntry).where(AuditEntry.seq == seq).values(**before))
    assert audit.first_broken(trail(rig)) is None
    assert erase(rig, "P2") == 0
    assert audit.first_broken(trail(rig)) is None, "two erasures"
    assert "P1" not in str([entry.as_dict() for entry in trail(rig)])
