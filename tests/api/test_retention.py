"""What is deleted, and what is not: a participant's erasure to the last byte, rules by age, cut off at every moment."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from stimrig.api.cli import main
from stimrig.api.errors import ApiError
from stimrig.api.models import erasure
from stimrig.api.models.erasure import Eraser
from stimrig.api.store import Store, audit, copies, migrations
from stimrig.api.store.tables import Approval, AuditEntry, Erasure, Participant, Recording, Test, Token
from tests.api.conftest import STUB, serving
from tests.api.conftest import run_test as plays
from tests.api.rig_data import Rig
from tests.api.rig_data import rig as rig
from tests.api.test_schemas import unmet

CODE = "XQ7ZZ81"


def eraser(rig: Rig, *more: Path) -> Eraser:
    return Eraser(rig.store, rig.clock, [rig.folder, *more])


def ended(rig: Rig, code: str, sessions: int = 2) -> None:
    """Sessions of days that are over: no model of theirs is in use."""
    for _ in range(sessions):
        rig.session(code)
    with rig.store.write() as session:
        session.execute(update(Approval).where(Approval.participant == code).values(expires_utc=rig.clock.utc()))
    rig.clock.sleep(60)


def holding(folder: Path, text: str) -> list[str]:
    """Files below a folder that have this text in them, or in their names."""
    found = [path for path in folder.rglob("*") if path.is_file()]
    return [path.name for path in found if text in path.name or text.encode() in path.read_bytes()]


def trail(rig: Rig) -> list[AuditEntry]:
    return rig.store.all(AuditEntry, order=AuditEntry.seq)


# ---- a participant


def test_nothing_of_a_person_stays_and_nothing_of_others_goes(tmp_path: Path, short_dir: Path) -> None:
    """Everything that the pages write of a participant, on a real service; then every byte is read."""
    tests: dict[str, Any] = {}
    with serving(tmp_path, short_dir, STUB) as (_, http):
        for code in ("P1", CODE):
            http.post("/v1/participants", json={"code": code, "side": "left", "muscle": "biceps"})
            test = tests[code] = plays(http, code)
            note = {"kind": "other", "text": f"said that {code} slept badly", "test_id": test["id"]}
            assert http.post(f"/v1/participants/{code}/notes", json=note).status_code == 201
            assert http.post(f"{test['model_url']}/approve", json={"reason": f"{code} is well"}).status_code == 200
            key = {"name": "ilc", "current_ma": 8, "max_pulse_width_us": 200, "max_duration_s": 60, "trials": 3}
            assert http.post(f"/v1/participants/{code}/keys", json=key).status_code == 201
            assert http.get(f"{test['model_url']}/diagnosis?wait=false").is_success
        kept = http.get("/v1/participants/P1/model").json()
        recording = http.get(tests["P1"]["recording_url"]).content
        before = [entry["hash"] for entry in http.get("/v1/audit").json()["entries"]]
    copies.copy_database(tmp_path / "stimrig.db", tmp_path / migrations.BEFORE / "stimrig-0001.db")
    assert {"stimrig.db", "stimrig-0001.db"} <= set(holding(tmp_path, CODE))
    asked = ["retention", "erase", CODE, "--reason", "asked by letter 12", "--data", str(tmp_path)]
    assert main.run(asked) == 2, "a model is in use: that is told first"
    assert main.run([*asked, "--though-in-use", "--json"]) == 0
    assert holding(tmp_path, CODE) == [] and holding(tmp_path, tests[CODE]["id"]) == []
    assert main.run(["audit", "verify", "--data", str(tmp_path)]) == 0
    with serving(tmp_path, short_dir, STUB) as (_, http):
        assert http.get(f"/v1/participants/{CODE}").status_code == 404
        assert http.get("/v1/participants/P1/model").json() == kept
        assert http.get(tests["P1"]["recording_url"]).content == recording
        told = http.get("/v1/audit").json()
        assert told["whole"] and [entry["hash"] for entry in told["entries"]][: len(before)] == before
        assert http.get("/administration").status_code == 200
        blank = [entry for entry in told["entries"] if entry["subject"] == "(erased)"]
        assert len(blank) >= 6 and {"approve", "set profile"} & {entry["action"] for entry in blank}
        assert http.post("/v1/participants", json={"code": CODE}).status_code == 201, "a code that is free again"


def test_it_says_what_it_would_do_and_what_it_did(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    ended(rig, "P1")
    verb = ["retention", "erase", "P1", "--data", str(rig.folder), "--reason"]
    assert main.run([*verb, "asked", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "would be deleted" in said and "2 recordings" in said and "2 files" in said and "backups" in said
    assert rig.store.get(Participant, "P1") is not None and len(holding(rig.folder / "recordings", "")) == 2
    for reason in ("", "P1 has died"):
        assert main.run([*verb, reason]) == 2 and "--reason" in capsys.readouterr().err
    assert main.run([*verb, "asked", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rows"] == {
        "analyses": 0, "tracked": 0, "approvals": 2, "notes": 0, "models": 2, "recordings": 2,
        "tests": 2, "tokens": 0, "participants": 1,
    }  # fmt: skip
    assert found["files"] == 2 and len(found["remains"]) == 4 and unmet("retention", found) == []
    (done,) = rig.store.all(Erasure)
    assert (done.id, done.of, done.files) == (found["erasure"], "(erased)", []) and done.done_utc
    assert main.run([*verb, "asked"]) == 2 and "There is no participant" in capsys.readouterr().err


def test_refused_while_a_test_goes_on_or_a_service_runs(
    rig: Rig, tmp_path: Path, short_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended(rig, "P1")
    test = rig.begin_test("P2")
    with pytest.raises(ApiError, match=r"Test T.* is requested"):
        eraser(rig).erase("P1", "asked", "Ada")
    with pytest.raises(ApiError, match=r"Test T.* is requested"):
        eraser(rig).remove_files(rig.store.all(Recording), "rule", "Ada")
    with rig.store.write() as session:
        session.execute(update(Test).where(Test.id == test).values(state="completed"))
    monkeypatch.setenv("STIMRIG_RETENTION_HOLD", "P9, P1")
    asked = ["retention", "erase", "P1", "--reason", "asked", "--data", str(rig.folder)]
    assert main.run(asked) == 2 and "STIMRIG_RETENTION_HOLD" in capsys.readouterr().err
    monkeypatch.delenv("STIMRIG_RETENTION_HOLD")
    with serving(tmp_path / "other", short_dir, STUB):
        asked[-1] = str(tmp_path / "other")
        assert main.run(asked) == 2 and "Stop the service first" in capsys.readouterr().err
    assert main.run([*asked[:-1], str(tmp_path / "nowhere")]) == 2 and "no database" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()


def test_what_a_controller_may_still_use_is_told_first(rig: Rig) -> None:
    rig.session("P1")
    with pytest.raises(ApiError, match="is approved until"):
        eraser(rig).erase("P1", "asked", "Ada")
    ended(rig, "P2", 1)
    key = Token(hash="h" * 64, prefix="k", name="ilc", scopes=["run-test"], created_utc=rig.now, participant="P2")
    rig.add(key)
    with pytest.raises(ApiError, match="a controller's key is valid"):
        eraser(rig).erase("P2", "asked", "Ada")
    assert eraser(rig).erase("P2", "asked", "Ada", though_in_use=True)[1].counts["tokens"] == 1


def test_the_rigs_own_files_go_too(rig: Rig, tmp_path: Path) -> None:
    """The service sees the rig's recordings in another place; journals of its tests lie beside them."""
    ended(rig, "P1", 1)
    own = tmp_path / "rig"
    for name in ("recordings/20260101T000000Z_T1.h5", "journals/T1.journal", "recordings/20260101T000000Z_T11.h5"):
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).write_bytes(b"x")
    (own / "recordings" / "R2.h5").write_bytes(b"x")
    assert len(eraser(rig, own).erase("P1", "asked", "Ada")[1].files) == 4
    assert [path.name for path in own.rglob("*") if path.is_file()] == ["20260101T000000Z_T11.h5"]


def test_a_file_outside_of_the_data_folders_stays(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> None:
    """The service writes the database; whoever erases may be root."""
    ended(rig, "P1", 1)
    other = tmp_path_factory.mktemp("elsewhere") / "shadow"
    other.write_text("of another program")
    (rig.folder / "link").symlink_to(other.parent)
    for path in (
        other,
        rig.folder / "link" / "shadow",
        Path(f"{rig.folder}/../{os.path.relpath(other, rig.folder.parent)}"),
    ):
        with rig.store.write() as session:
            session.execute(update(Recording).values(path=str(path)))
        with pytest.raises(ApiError, match="none of the data folders"):
            eraser(rig).erase("P1", "asked", "Ada")
        assert other.exists() and rig.store.get(Participant, "P1") is not None, "nothing is half"


def test_files_that_were_restored_to_another_folder_go_too(rig: Rig, tmp_path: Path) -> None:
    ended(rig, "P1", 1)
    (kept,) = (rig.folder / "recordings").rglob("*.h5")
    moved = tmp_path / "restored" / "recordings" / "deep" / kept.name
    moved.parent.mkdir(parents=True)
    kept.rename(moved)
    eraser(rig, tmp_path / "restored").erase("P1", "asked", "Ada")
    assert not moved.exists()


def test_options_before_the_word_are_refused(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    ended(rig, "P1")
    words = ["erase", "P1", "--reason", "asked", "--data", str(rig.folder)]
    for before in (["--delete"], ["--data", str(rig.folder)], ["--rig-data", str(rig.folder)], ["--json"]):
        assert main.run(["retention", *before, *words]) == 2
        assert "behind erase" in capsys.readouterr().err
    assert main.run(["retention", "--dry-run", *words]) == 2 and capsys.readouterr().err
    assert main.run(["retention", *words, "--dry-run"]) == 0, "it is still there"


# ---- the trail


def test_only_what_an_entry_vouches_for_may_be_blank(rig: Rig) -> None:
    ended(rig, "P1", 1)
    ended(rig, "P2", 1)
    eraser(rig).erase("P1", "asked", "Ada")
    assert audit.first_broken(trail(rig)) is None
    other = next(entry for entry in trail(rig) if entry.subject == "P2")
    last = trail(rig)[-1].seq
    blank = next(entry for entry in trail(rig) if entry.subject == audit.ERASED)
    for seq, changed in (
        (other.seq, {"subject": audit.ERASED, "detail": {"erased": last}}),  # one more than was vouched for
        (blank.seq, {"who": "Eve"}),
        (blank.seq, {"at_utc": "2020-01-01T00:00:00.000Z"}),
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
    eraser(rig).erase("P2", "asked", "Ada")
    assert audit.first_broken(trail(rig)) is None, "two erasures"
    assert "P1" not in str([entry.as_dict() for entry in trail(rig)])


@pytest.mark.parametrize("code", ["tests", "kept", "reason", "a"])
def test_a_code_that_is_a_word_of_the_trail_or_in_a_persons_name(rig: Rig, code: str) -> None:
    """Neither what an earlier erasure vouches for breaks, nor does the trail forget who did what."""
    ended(rig, "P1", 1)
    ended(rig, code, 1)
    eraser(rig).erase("P1", "asked", "Ada")
    eraser(rig).erase(code, "asked", "Ada")
    assert audit.first_broken(trail(rig)) is None
    assert [entry.action for entry in trail(rig) if entry.subject != audit.ERASED][-2:] == [audit.ERASE] * 2
    assert {entry.who for entry in trail(rig) if entry.action == "approve"} == {"Ada"}


# ---- cut off


def cut_off(folder: Path, after: int) -> None:
    """In a process of its own: it is killed before its nth step."""
    steps = iter(range(10_000))

    def step(work: Any) -> Any:
        def taken(*given: Any, **more: Any) -> Any:
            if next(steps) == after:
                os.kill(os.getpid(), signal.SIGKILL)
            return work(*given, **more)

        return taken

    made = Rig(folder, feed=False)
    made.clock.sleep(86_400.0)
    for name in ("_remove", "_tell_anew", "_names"):
        setattr(erasure, name, step(getattr(erasure, name)))
    for name in ("finish", "_intend", "_blank", "_compact", "waiting"):
        setattr(Eraser, name, step(getattr(Eraser, name)))
    write = Store.write

    @contextmanager
    def committed(store: Store) -> Iterator[Any]:
        with write(store) as session:
            yield session
        step(lambda: None)()

    Store.write = committed  # type: ignore[method-assign]
    eraser(made).erase("P1", "asked", "Ada")
    made.close()


@pytest.mark.slow
def test_killed_at_every_step_it_is_all_or_nothing_and_goes_on(tmp_path: Path) -> None:
    ways, after = set(), 0
    while True:
        folder = tmp_path / str(after)
        with closing(Rig(folder)) as made:
            ended(made, "P1", 3)
            ended(made, "P2", 1)
        process = multiprocessing.get_context("fork").Process(target=cut_off, args=(folder, after))
        process.start()
        process.join(60)
        killed = process.exitcode == -signal.SIGKILL
        assert killed or process.exitcode == 0
        with closing(Rig(folder, feed=False)) as made:
            rows = {table.__tablename__: len(made.store.all(table)) for table in (Participant, Recording, Approval)}
            files = len(list((folder / "recordings").glob("*.h5")))
            whole = rows == {"participants": 2, "recordings": 4, "approvals": 4}
            assert whole or rows == {"participants": 1, "recordings": 1, "approvals": 1}, rows
            assert (files == 4) if whole else (1 <= files <= 4)
            assert audit.first_broken(trail(made)) is None
            ways.add((whole, files))
            if whole:
                made.clock.sleep(86_400.0)
                eraser(made).erase("P1", "asked", "Ada")
            eraser(made).finish()
            assert len(list((folder / "recordings").glob("*.h5"))) == 1 and eraser(made).waiting() == []
        if not killed:
            break
        after += 1
    assert after > 10 and {(True, 4), (False, 4), (False, 3), (False, 2), (False, 1)} <= ways


def test_a_file_that_cannot_be_removed_is_told_and_gone_on_with(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    ended(rig, "P1", 2)

    def refused(path: Path, **_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refused)
        with pytest.raises(ApiError, match="Permission denied"):
            eraser(rig).erase("P1", "asked", "Ada")
    assert len(eraser(rig).waiting()) == 1 and rig.store.get(Participant, "P1") is None
    eraser(rig).finish()
    assert not eraser(rig).waiting() and not list((rig.folder / "recordings").glob("*.h5"))


# ---- rules


def test_rules_let_go_what_is_old_and_nothing_else(rig: Rig) -> None:
    day = 86_400.0
    ended(rig, "old")
    ended(rig, "held")
    rig.clock.sleep(40 * day)
    ended(rig, "newer", 1)
    rig.clock.sleep(day)
    assert [one.code for one in eraser(rig).old_participants(30, ["held"])] == ["old"]
    assert [row.participant for row in eraser(rig).old_recordings(30, ["held"])] == ["old", "old"]
    assert eraser(rig).old_recordings(42) == [] and eraser(rig).old_participants(42) == []
    assert eraser(rig).remove_files(eraser(rig).old_recordings(30, ["held"]), "rule", "retention")
    assert [row.path == "" for row in rig.store.all(Recording, order=Recording.created_utc)] == [True] * 2 + [False] * 3
    assert len(list((rig.folder / "recordings").glob("*.h5"))) == 3
    assert all(len(row.file_sha256) == 64 for row in rig.store.all(Recording)), "the hash stays"
    assert audit.first_broken(trail(rig)) is None and trail(rig)[-1].action == "delete recordings"
    assert eraser(rig).remove_files([], "rule", "retention") is None
    rig.session("old")
    assert "old" not in [one.code for one in eraser(rig).old_participants(30)], "its model is in use"


def test_whose_recording_was_uploaded_of_late_is_not_old(rig: Rig) -> None:
    """An upload makes no test: the rule for participants must see it all the same."""
    ended(rig, "P1", 1)
    rig.clock.sleep(40 * 86_400.0)
    assert [one.code for one in eraser(rig).old_participants(30)] == ["P1"]
    upload = {"test_id": None, "origin": "upload", "path": "", "file_sha256": "0" * 64}
    rig.add(Recording(id="upload-1", participant="P1", created_utc=rig.clock.utc(), **upload))
    assert eraser(rig).old_participants(30) == []
    rig.clock.sleep(31 * 86_400.0)
    assert [one.code for one in eraser(rig).old_participants(30)] == ["P1"]


def test_the_verb_does_what_the_settings_say(
    rig: Rig, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended(rig, "P1")
    log = rig.folder / "logs" / "api.log"
    log.parent.mkdir()
    log.write_text("x")
    os.utime(log, (0, 0))
    rig.clock.sleep(0)
    verb = ["retention", "--data", str(rig.folder)]
    assert main.run([*verb, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rules"] == {"participants": None, "recordings": None, "logs": None}
    assert rig.store.get(Participant, "P1") is not None and log.exists(), "without a rule all is kept"
    assert main.run(verb) == 0 and "no rule" in capsys.readouterr().out
    monkeypatch.setenv("STIMRIG_RETENTION_LOGS_DAYS", "30")
    monkeypatch.setattr("stimrig.api.clock.Clock.unix_s", lambda _self: rig.clock.now_s + 50 * 86_400.0)
    monkeypatch.setenv("STIMRIG_RETENTION_RECORDINGS_DAYS", "10")
    assert main.run(verb) == 0 and "recordings: 2 would go" in capsys.readouterr().out
    assert log.exists() and len(list((rig.folder / "recordings").glob("*.h5"))) == 2
    assert main.run([*verb, "--delete", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert unmet("retention", found) == []
    assert not found["dry_run"] and len(found["recordings"]) == 2
    assert found["logs"][0]["file"] == "api.log" and not log.exists()
    assert not list((rig.folder / "recordings").glob("*.h5")) and rig.store.get(Participant, "P1") is not None
    monkeypatch.setenv("STIMRIG_RETENTION_PARTICIPANTS_DAYS", "20")
    assert main.run([*verb, "--delete", "--json"]) == 0
    assert [one["code"] for one in json.loads(capsys.readouterr().out)["participants"]] == ["P1"]
    assert rig.store.get(Participant, "P1") is None and audit.first_broken(trail(rig)) is None
    monkeypatch.setenv("STIMRIG_RETENTION_PARTICIPANTS_DAYS", "0")
    assert main.run(verb) == 2 and "STIMRIG_RETENTION_PARTICIPANTS_DAYS" in capsys.readouterr().err


def test_a_recording_that_a_rule_took_says_so(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, STUB) as (service, http):
        http.post("/v1/participants", json={"code": "P1"})
        test = plays(http, "P1")
        Eraser(service.context.store, service.context.clock, [tmp_path]).remove_files(
            service.context.store.all(Recording), "rule", "retention"
        )
        gone = http.get(test["recording_url"])
        assert gone.status_code == 410 and "rule of retention" in gone.json()["detail"]
        assert http.get(f"{test['recording_url']}/csv").status_code == 410
        assert http.get(f"/models/{test['model_id']}").status_code == 200
        assert http.get(f"{test['model_url']}/file").status_code == 200
    with serving(tmp_path, short_dir, STUB) as (_, http):
        assert http.get("/health").json()["database"] == "ok"
