"""The outbox is written with the rows it tells of: the same transaction, in order, a chain that holds."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from sqlalchemy import inspect

from stimrig.api.outbox import chain, feed
from stimrig.api.outbox.feed import Feed
from stimrig.api.store import audit, uploads
from stimrig.api.store.tables import Approval, Model, Note, OutboxItem, Participant, Recording, Test
from stimrig.rig.messages import LABELS, TestPlan
from tests.api.outbox.conftest import Rig, assert_chain, sha256


def as_items(rig: Rig) -> list[dict[str, Any]]:
    return [item.as_dict() for item in rig.items()]


def body_of(rig: Rig, kind: str) -> dict[str, Any]:
    return json.loads([item.body for item in rig.items() if item.kind == kind][-1])


def test_a_session_is_told_in_order_with_its_files(rig: Rig) -> None:
    model = rig.session("P1")
    rig.tracked(model)
    kinds = [kind for kind, _ in rig.told()]
    assert kinds == [
        "begin", "participant", "audit", "audit", "recording", "audit", "model", "audit", "test", "decision", "audit",
        "audit", "tracked", "audit",
    ]  # fmt: skip
    assert_chain(as_items(rig))
    files = {item.kind: (item.file, item.file_bytes) for item in rig.items() if item.file is not None}
    recording = rig.store.all(Recording)[0]
    assert files["recording"] == (recording.file_sha256, 1000)
    assert files["model"] == (model.etag, len(model.document))
    assert set(files) == {"recording", "model", "tracked"}
    assert json.loads(rig.items()[0].body) == {"after": None} and rig.items()[0].key == rig.items()[0].chain


def test_nothing_that_a_person_typed_freely_and_no_path_is_told(rig: Rig) -> None:
    rig.session("P1")
    note = Note(id="N1", participant="P1", kind="pain", text="Mr Miller said it hurt", by="Ada", at_utc=rig.now)
    rig.add(note, action="add note", subject="N1")
    everything = "".join(item.body for item in rig.items())
    assert "Miller" not in everything and "felt fine" not in everything
    assert str(rig.folder) not in everything
    assert body_of(rig, "recording")["name"] == "R2.h5"
    assert "reason" not in body_of(rig, "decision") and "document" not in body_of(rig, "model")


def test_a_test_is_told_once_it_is_closed_and_without_its_pulses(rig: Rig) -> None:
    test_id = rig.begin_test("P1")
    for state in ("running", "sealing", "identifying"):
        with rig.store.write() as session:
            session.get(Test, test_id).state = state  # pyright: ignore[reportOptionalMemberAccess]
    assert ("test", test_id) not in rig.told()
    with rig.store.write() as session:
        session.get(Test, test_id).state = "stopped"  # pyright: ignore[reportOptionalMemberAccess]
    assert rig.told()[-1] == ("test", test_id)
    plan = body_of(rig, "test")["plan"]
    assert plan["preview"] == {"duration_s": 30.0} and plan["kind"] == "identification"
    with rig.store.write() as session:
        session.get(Test, test_id).ran_by = "Bob"  # pyright: ignore[reportOptionalMemberAccess]
    assert rig.told()[-2:] == [("test", test_id)] * 2 and body_of(rig, "test")["ran_by"] == "Bob"


def test_what_a_test_newly_holds_stays_at_the_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field of a plan, a label and a column leave only where they are named."""
    typed = {"posture": "sits as Mr Miller wants", "placement": "A", "participant": "P1", "side": "left"}
    told = feed.telling(Test(id="T0", state="completed", plan=typed, summary={}))
    assert told is not None and told.body["plan"] == {"participant": "P1", "side": "left"}
    assert set(told.body) == set(Test.__table__.columns.keys()) - {"followed_by", "rig"}
    assert set(TestPlan.model_fields) - set(feed.OF_PLAN) <= set(LABELS) - {"participant", "kind"}
    monkeypatch.setattr(Test.__table__, "columns", {**Test.__table__.columns, "posture": Test.__table__.c.reason})
    again = feed.telling(Test(id="T0", state="completed", plan=typed, summary={}))
    assert again == told


def test_what_is_rolled_back_is_not_told(rig: Rig) -> None:
    rig.participant("P1")
    before = as_items(rig)
    with pytest.raises(RuntimeError, match="on purpose"), rig.store.write() as session:
        session.add(Participant(code="P2", profile={}, created_utc=rig.now, created_by="Ada"))
        session.flush()
        audit.write(session, rig.now, "Ada", "create participant", "P2")
        raise RuntimeError("on purpose")
    assert as_items(rig) == before
    rig.participant("P2")
    assert_chain(as_items(rig))


def test_items_and_rows_stand_or_fall_together(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.participant("P1")
    with monkeypatch.context() as patch:
        patch.setattr(chain, "_append", Mock(side_effect=RuntimeError("on purpose")))
        with pytest.raises(RuntimeError, match="on purpose"):
            rig.participant("P2")
    assert rig.store.get(Participant, "P2") is None


def test_a_savepoint_that_is_rolled_back_is_not_told(rig: Rig) -> None:
    with rig.store.write() as session:
        session.add(Participant(code="P1", profile={}, created_utc=rig.now, created_by="Ada"))
        session.flush()
        inner = session.begin_nested()
        session.add(Participant(code="P2", profile={}, created_utc=rig.now, created_by="Ada"))
        session.flush()
        inner.rollback()
    assert [key for kind, key in rig.told() if kind == "participant"] == ["P1"]


def test_a_row_that_cannot_be_told_keeps_nobody_from_working(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(feed, "_bounded", Mock(side_effect=ValueError("on purpose")))
        rig.participant("P1")
    assert rig.store.get(Participant, "P1") is not None and [kind for kind, _ in rig.told()] == ["begin", "audit"]
    assert sum(feed.batches(rig.store, rig.clock)) == 1, "it is found the next time"


def test_every_audit_entry_is_told_by_its_hash(rig: Rig) -> None:
    with rig.store.write() as session:
        for number in range(3):
            audit.write(session, rig.now, "Ada", "look", str(number))
    assert rig.told()[1:] == [("audit", "1"), ("audit", "2"), ("audit", "3")]
    assert set(body_of(rig, "audit")) == {"seq", "hash", "previous_hash", "at_utc"}


def test_the_same_content_is_told_once(rig: Rig) -> None:
    row = rig.participant("P1")
    count = len(rig.items())
    with rig.store.write() as session:
        session.merge(row).profile = {"current_ma": 20.0}
    assert len(rig.items()) == count


def test_what_json_cannot_hold_and_what_is_too_long_are_left_out(rig: Rig) -> None:
    rig.participant("P1")
    deep: Any = 1
    for _ in range(60):
        deep = [deep]
    test_id = rig.begin_test("P1")
    summary = {"nan": float("nan"), "long": [0.5] * 200_000, "deep": deep, "n": 1, "surrogate": "\ud800"}
    told = feed.telling(Test(id="T0", state="completed", plan={}, summary=summary))
    assert told is not None and told.body["summary"]["nan"] is None and told.body["summary"]["surrogate"] == "?"
    with rig.store.write() as session:
        row = session.get(Test, test_id)
        assert row is not None
        row.state, row.summary = "completed", {"long": [0.5] * 200_000, "deep": deep, "n": 1}
    body = body_of(rig, "test")
    assert body["summary"]["long"] == {"left_out": 200_000} and body["summary"]["n"] == 1
    assert len(rig.items()[-1].body) < 500_000
    assert_chain(as_items(rig))


def test_an_upload_has_its_length_before_it_comes_to_its_place(rig: Rig) -> None:
    rig.participant("P1")
    path = rig.folder / "recordings" / "upload-1.csv"
    uploads.part_of(path).parent.mkdir()
    uploads.part_of(path).write_bytes(b"123")
    row = Recording(id="upload-1", participant="P1", path=str(path), file_sha256=sha256(b"123"), origin="upload")
    row.created_utc = rig.now
    with uploads.taken_in(path), rig.store.write() as session:
        session.add(row)
    assert (rig.items()[-1].file, rig.items()[-1].file_bytes) == (sha256(b"123"), 3)


# ---- reconcile --------------------------------------------------------------------------------------------------


def some_days(rig: Rig) -> None:
    for code in ("P1", "P2"):
        rig.participant(code)
        rig.clock.sleep(60)
    for code in ("P1", "P2", "P1"):
        rig.tracked(rig.session(code))
        rig.clock.sleep(3600)


def newest(rig: Rig) -> dict[tuple[str, str], tuple[str, str | None]]:
    return {(item.kind, item.key): (item.sha256, item.file) for item in rig.items() if item.kind != "begin"}


def test_nothing_is_fed_without_a_centre_and_all_of_it_later(tmp_path: Path) -> None:
    without, fed = Rig(tmp_path / "without", feed=False), Rig(tmp_path / "fed")
    some_days(without)
    some_days(fed)
    assert without.items() == []
    for _ in feed.batches(without.store, without.clock):
        pass
    assert newest(without) == newest(fed)
    assert_chain([item.as_dict() for item in without.items()])
    times = []
    for item in without.items()[1:-1]:
        body = json.loads(item.body)
        times.append(
            next(body[name] for name in ("finished_utc", "requested_utc", "created_utc", "at_utc") if body.get(name))
        )
    assert times == sorted(times), "in order of time"
    count = len(without.items())
    assert sum(feed.batches(without.store, without.clock)) == 0 and len(without.items()) == count
    for rig in (without, fed):
        rig.close()


def test_what_was_changed_while_no_centre_was_configured_is_put_in(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    some_days(rig)
    rig.close()
    again = Rig(tmp_path, feed=False)
    with again.store.write() as session:
        session.get(Participant, "P2").archived_utc = again.now  # pyright: ignore[reportOptionalMemberAccess]
        audit.write(session, again.now, "Ada", "archive", "P2")
    before = again.told()
    assert sum(feed.batches(again.store, again.clock)) == 2
    assert {kind for kind, _ in again.told()[len(before) :]} == {"participant", "audit"}
    again.close()


def test_a_recording_whose_file_comes_back_is_told_with_it(rig: Rig) -> None:
    rig.participant("P1")
    data = b"sealed"
    path = rig.folder / "recordings" / "late.h5"
    row = Recording(id="R9", participant="P1", path=str(path), file_sha256=sha256(data), created_utc=rig.now)
    rig.add(row)
    assert (rig.items()[-1].file, rig.items()[-1].file_bytes) == (None, None)
    path.write_bytes(data)
    assert sum(feed.batches(rig.store, rig.clock)) == 1
    assert (rig.items()[-1].file, rig.items()[-1].file_bytes) == (sha256(data), 6)
    path.unlink()
    assert sum(feed.batches(rig.store, rig.clock)) == 0, "a file that is gone is no news of the row"


@pytest.mark.parametrize("seed", range(8))
def test_whatever_is_done_in_whatever_order_the_newest_items_are_the_rows(tmp_path: Path, seed: int) -> None:
    """Changes by chance, some rolled back, some while no feed listens: reconciled, the outbox says what the rows do."""
    chance = random.Random(seed)
    rig = Rig(tmp_path, feed=chance.random() < 0.5, seed=seed)
    rig.participant("P0")
    for number in range(1, 30):
        rig.clock.sleep(chance.choice((0.0, 0.001, 60.0)))
        codes = [row.code for row in rig.store.all(Participant)]
        try:
            with rig.store.write() as session:
                kind = chance.randrange(4)
                if kind == 0:
                    row = Participant(code=f"P{number}", profile={}, created_utc=rig.now, created_by="Ada")
                    session.add(row)
                elif kind == 1:
                    session.get(Participant, chance.choice(codes)).muscle = f"m{number}"  # pyright: ignore[reportOptionalMemberAccess]
                session.flush()
                if chance.random() < 0.3:
                    raise RuntimeError
        except RuntimeError:
            pass
        if chance.random() < 0.5:
            rig.session(chance.choice(codes))
        if chance.random() < 0.1:
            rig.close()
            rig = Rig(tmp_path, feed=chance.random() < 0.5, seed=seed + 1000 * number)
            rig.number = 1000 * number
    for _ in feed.batches(rig.store, rig.clock):
        pass
    assert_chain(as_items(rig))
    told = newest(rig)
    for table, kind in (
        (Participant, "participant"),
        (Recording, "recording"),
        (Model, "model"),
        (Approval, "decision"),
    ):
        keys = {str(inspect(row).identity[0]) for row in rig.store.all(table)}
        assert keys == {key for of, key in told if of == kind}
    for row in rig.store.all(Participant):
        bodies = [json.loads(item.body) for item in rig.items() if (item.kind, item.key) == ("participant", row.code)]
        assert bodies[-1] | {"placement": row.placement} == row.as_dict(), "what is typed freely stays at the rig"
    rig.close()


def test_two_feeds_on_one_store_tell_once(rig: Rig) -> None:
    Feed(rig.store, rig.clock)
    rig.participant("P1")
    assert len([1 for item in rig.store.all(OutboxItem) if item.kind == "participant"]) == 1
