"""The audit trail, edited and its chain made anew from there on: nothing in the database tells it, the receipts do."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, insert, select

from stimrig.api.cli import main
from stimrig.api.clock import Clock
from stimrig.api.outbox import receipts
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.pusher import Pusher
from stimrig.api.settings import Settings
from stimrig.api.store import audit
from stimrig.api.store.audit import entry_hash
from stimrig.api.store.tables import AuditEntry, OutboxItem
from tests.api.centre.conftest import Centre
from tests.api.outbox.conftest import Rig


class Trail:
    """A rig that has told a centre of its trail, and what one finds in it with `stimrig audit verify`."""

    def __init__(self, folder: Path, centre: Centre, key: str, say: Callable[[], str]) -> None:
        self.rig, self.centre, self.key, self.say = Rig(folder), centre, key, say
        self.settings = Settings(data_dir=folder, centre_url=centre.url, centre_key=key)  # pyright: ignore[reportArgumentType]

    def work(self, count: int) -> None:
        """So many entries."""
        for number in range(count):
            self.rig.clock.sleep(60)
            self.rig.add(action="look", subject=f"P{number}")

    def push(self) -> None:
        """By a process that begins, as after a restart, until there is nothing more to tell."""
        link = Link(self.centre.url, self.key, self.rig.clock)
        pusher = Pusher(self.rig.store, self.settings, self.rig.clock, link, self.rig.clock.sleep)
        while pusher.turn() == 0.0:
            pass
        link.close()
        assert pusher.telling.waiting() == (0, 0)

    def entries(self) -> list[AuditEntry]:
        return self.rig.store.all(AuditEntry, order=AuditEntry.seq)

    def remake(self, seq: int, **changed: Any) -> None:
        """Edit an entry, and make the chain anew from there on, in the table alone."""
        previous = self.entries()[seq - 2].hash
        with self.rig.store.engine.begin() as connection:
            for entry in self.entries()[seq - 1 :]:
                fields = entry.as_dict() | {"previous_hash": previous} | (changed if entry.seq == seq else {})
                previous = fields["hash"] = entry_hash(fields)
                connection.execute(delete(AuditEntry).where(AuditEntry.seq == entry.seq))
                connection.execute(insert(AuditEntry), [fields])
        assert audit.first_broken(self.entries()) is None, "the chain alone says nothing"

    def cut(self, seq: int) -> None:
        """Take the end off, from an entry on."""
        with self.rig.store.engine.begin() as connection:
            connection.execute(delete(AuditEntry).where(AuditEntry.seq >= seq))

    def verify(self, *more: str) -> tuple[int, dict[str, Any]]:
        code = main.run(["audit", "verify", "--data", str(self.rig.folder), "--json", *more])
        return code, json.loads(self.say())

    def words(self, *more: str) -> str:
        assert main.run(["audit", "verify", "--data", str(self.rig.folder), *more]) == 1
        return self.say()

    def warnings(self) -> list[str]:
        """Of the centre, but for the rig's clock: here it runs ahead."""
        return [kind for _, kind in self.centre.warnings() if kind != "clock"]

    @property
    def file(self) -> Path:
        (path,) = receipts.files(self.rig.folder)
        return path


@pytest.fixture
def trail(
    tmp_path: Path, centre: Centre, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Trail]:
    made = Trail(tmp_path / "rig", centre, centre.key(), lambda: capsys.readouterr().out)
    monkeypatch.setenv("STIMRIG_DATABASE_URL", made.rig.store.engine.url.render_as_string(hide_password=False))
    made.work(10)
    made.push()
    capsys.readouterr()
    yield made
    made.rig.close()


def test_each_entry_has_a_receipt_in_a_file_that_only_its_owner_reads(trail: Trail) -> None:
    kept, wrong = receipts.checked(trail.file)
    assert [(one.seq, one.hash) for one in kept] == [(entry.seq, entry.hash) for entry in trail.entries()]
    assert wrong == [] and all(one.holds and one.rig == "Ward 1" for one in kept)
    assert trail.file.stat().st_mode & 0o777 == 0o600
    assert trail.verify() == (
        0,
        {"whole": True, "first_broken": None, "missing_since": None, "head_found": True, "receipts": 10,
         "receipts_wrong": [], "centre": "none is configured", "entries": 10, "head": trail.entries()[-1].hash},
    )  # fmt: skip
    trail.push()
    assert len(receipts.checked(trail.file)[0]) == 10, "a pusher that begins again asks for none twice"


def test_an_edited_entry_is_named_though_the_chain_was_made_anew(trail: Trail) -> None:
    was = trail.entries()[4].hash
    trail.remake(5, who="Mallory")
    code, found = trail.verify()
    assert (code, found["whole"], found["first_broken"], found["missing_since"]) == (1, False, 5, None)
    said = trail.words()
    assert "entry 5 is not the one that was countersigned by the centre on" in said
    assert "Mallory did “look” to P4" in said and was in said
    assert receipts.check_folder(trail.entries(), trail.rig.folder).first_broken == 5, "the page, REST and the doctor"


def test_the_centre_sees_it_with_the_next_entry_and_names_the_first_one_after_a_restart(trail: Trail) -> None:
    trail.remake(5, who="Mallory")
    link = Link(trail.centre.url, trail.key, trail.rig.clock)
    pusher = Pusher(trail.rig.store, trail.settings, trail.rig.clock, link, trail.rig.clock.sleep)
    pusher._missing = None  # it was running all the time
    trail.work(1)
    while pusher.turn() == 0.0:
        pass
    assert trail.warnings() == ["audit"], "what it follows is not what was told"
    trail.push()
    assert trail.warnings() == ["audit"], "one change, one warning"
    with trail.centre.client() as http:
        assert {"seq": 5} in [one["detail"] for one in http.get("/v1/warnings").json()]
    assert trail.verify()[1]["first_broken"] == 5, "what was told first counts"


def test_an_end_that_was_cut_off_is_missing(trail: Trail) -> None:
    trail.cut(8)
    code, found = trail.verify()
    assert (code, found["first_broken"], found["missing_since"]) == (1, None, 8)
    assert "entries are missing since 8" in trail.words()
    trail.remake(3, action="approve")
    assert (trail.verify()[1]["first_broken"], trail.verify()[1]["missing_since"]) == (3, 8)


@pytest.mark.sqlite
def test_a_restored_database_lacks_entries_and_was_not_changed(trail: Trail, tmp_path: Path) -> None:
    database, copy = trail.rig.folder / "stimrig.db", tmp_path / "copy.db"
    with closing(sqlite3.connect(database)) as one, closing(sqlite3.connect(copy)) as other:
        one.backup(other)
    trail.work(5)
    trail.push()
    trail.rig.close()
    for path in trail.rig.folder.glob("stimrig.db*"):
        path.unlink()
    copy.rename(database)
    clock = trail.rig.clock
    trail.rig = Rig(trail.rig.folder)
    trail.rig.clock.now_s = clock.now_s
    assert (trail.verify()[1]["first_broken"], trail.verify()[1]["missing_since"]) == (None, 11)
    trail.work(2)
    trail.push()
    assert trail.rig.store.all(OutboxItem.chain)[0] != trail.rig.store.all(OutboxItem.chain)[-1], "begun anew"
    code, found = trail.verify()
    assert (code, found["first_broken"], found["missing_since"]) == (1, None, 11)
    assert trail.verify("--restored", "11")[0] == 0 and trail.verify("--restored", "10")[0] == 1
    assert trail.warnings() == ["restored"]
    trail.remake(4, who="Mallory")
    assert trail.verify("--restored", "11")[1]["first_broken"] == 4


def test_a_file_of_receipts_that_was_edited_or_cut_is_told(trail: Trail) -> None:
    lines = trail.file.read_text("utf-8").splitlines(keepends=True)
    forged = json.loads(lines[4]) | {"hash": "f" * 64}
    trail.file.write_text("".join([*lines[:4], json.dumps(forged) + "\n", *lines[5:]]), "utf-8")
    code, found = trail.verify()
    assert code == 1 and f"{trail.file}, line 5: not as it was written" in found["receipts_wrong"][0]
    trail.file.write_text("".join([*lines[:4], *lines[6:]]), "utf-8")
    code, found = trail.verify()
    assert code == 1 and "the receipt of entry 5 is missing" in found["receipts_wrong"][0]
    trail.file.write_text("".join(lines)[:-9], "utf-8")  # a loss of power in the middle of a line
    trail.push()
    assert trail.verify()[0] == 0


def test_without_its_file_the_centre_is_asked(trail: Trail, monkeypatch: pytest.MonkeyPatch) -> None:
    trail.file.unlink()
    trail.remake(5, who="Mallory")
    assert trail.verify()[1]["first_broken"] is None
    monkeypatch.setenv("STIMRIG_CENTRE_URL", trail.centre.url)
    monkeypatch.setenv("STIMRIG_CENTRE_KEY", trail.key)
    code, found = trail.verify()
    assert (code, found["first_broken"], found["receipts"], found["centre"]) == (1, 5, 10, "asked")
    assert trail.verify("--no-centre")[1]["centre"] == "not asked"
    monkeypatch.setenv("STIMRIG_CENTRE_KEY", "another")
    assert "key revoked" in trail.verify()[1]["centre"]


def test_receipts_of_two_rigs_on_one_database_stay_apart(trail: Trail) -> None:
    """Two services with folders of their own push one trail, each with a key of its own."""
    other = Trail(trail.rig.folder.parent / "other", trail.centre, trail.centre.key("Ward 2"), trail.say)
    mine, other.rig.store = other.rig.store, trail.rig.store
    mine.close()
    other.push()
    trail.work(1)
    trail.push()
    other.push()
    for one, rig in ((trail, "Ward 1"), (other, "Ward 2")):
        kept, wrong = receipts.checked(one.file)
        assert ({each.rig for each in kept}, [each.seq for each in kept], wrong) == ({rig}, list(range(1, 12)), [])
    assert trail.verify("--heads", str(other.file))[0] == 0
    trail.remake(5, who="Mallory")
    assert trail.verify("--heads", str(other.file))[1]["first_broken"] == 5


def test_a_rig_without_a_centre_notes_its_heads(trail: Trail, tmp_path: Path) -> None:
    trail.file.unlink()
    noted = tmp_path / "heads.jsonl"
    noted.touch()
    assert trail.verify("--heads", str(noted))[0] == 1, "emptied, it would pass whatever was noted"
    of = ["audit", "heads", "--data", str(trail.rig.folder)]
    assert main.run([*of, "-o", str(noted)]) == 0
    trail.work(3)
    assert main.run([*of, "-o", str(noted)]) == 0
    assert main.run(of) == 0
    assert json.loads(trail.say())["seq"] == 13
    assert trail.verify("--heads", str(noted)) == (0, trail.verify()[1] | {"receipts": 2})
    trail.remake(12, who="Mallory")
    assert trail.verify("--heads", str(noted))[1]["first_broken"] == 13
    trail.remake(2, who="Mallory")
    assert "entry 10 is not the one that was noted on" in trail.words("--heads", str(noted))


def test_a_service_notes_its_head_once_an_hour(trail: Trail, tmp_path: Path) -> None:
    noted, clock = tmp_path / "heads.jsonl", Clock()
    for _ in range(3):
        receipts.note_hourly(trail.rig.store, clock, noted)
    assert [one.seq for one in receipts.checked(noted)[0]] == [10]
    os.utime(noted, (clock.unix_s() - receipts.HOUR_S,) * 2)
    receipts.note_hourly(trail.rig.store, clock, noted)
    assert [one.seq for one in receipts.checked(noted)[0]] == [10, 10]


def test_another_key_signs_nothing_that_holds(trail: Trail) -> None:
    (one, *_), _ = receipts.checked(trail.file)
    assert not one.model_copy(update={"key": "1" * 64}).holds
    assert not one.model_copy(update={"noted_utc": "2020-01-01T00:00:00Z"}).holds
    assert not one.model_copy(update={"key": ""}).holds
    assert trail.rig.store.all(OutboxItem.chain)[0] == one.chain
    with trail.rig.store.read() as session:
        assert session.scalar(select(OutboxItem.kind).where(OutboxItem.seq == one.item)) == "audit"


@pytest.mark.parametrize(("at_utc", "changed"), [("2026-01-01T00:00:00Z", True), ("2026-01-03T00:00:00Z", False)])
def test_under_a_chain_that_was_begun_anew_only_what_claims_an_older_time_was_changed(at_utc: str, changed: bool):
    """After a restore, later entries stand in the places of those that are missing."""
    entry = AuditEntry(seq=1, at_utc=at_utc, who="a", action="b", subject="", detail={}, previous_hash="0" * 64)
    entry.hash = entry_hash(entry.as_dict())
    old = receipts.Receipt(seq=1, hash="a" * 64, noted_utc="", at_utc="2026-01-02T00:00:00Z", chain="one", key="c" * 64)
    new = old.model_copy(update={"seq": 1, "hash": entry.hash, "chain": "two"})
    stands = receipts.standing([entry], [old, new])
    assert (stands.differs, stands.missing) == ((old, None) if changed else (None, old))
