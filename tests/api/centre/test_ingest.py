"""What rigs push is taken once, in order, whole, or not at all."""

from __future__ import annotations

import copy
import json
import sqlite3
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from sqlalchemy import update

from stimrig.api.centre import warnings
from stimrig.api.store.centre_tables import CentreItem, CentreRecording, CentreWarning
from tests.api.centre.conftest import AT, ZEROS, Centre, Teller, canonical, run_centre, sha256


def counts(centre: Centre) -> tuple[int, int]:
    """Items and recordings that the centre has."""
    return len(centre.context.store.all(CentreItem)), len(centre.context.store.all(CentreRecording))


def test_a_day_arrives_whole_and_is_handed_out_as_it_was(centre: Centre, rig: httpx.Client, http: httpx.Client) -> None:
    told = Teller()
    data = told.session()
    assert rig.post("/v1/rig/hello", json=told.hello(centre.clock.utc())).json()["seq"] == 0
    told.push(rig)
    greeted = rig.post("/v1/rig/hello", json=told.hello(centre.clock.utc())).json()
    assert (greeted["seq"], greeted["hash"]) == (6, told.items[-1]["hash"])
    assert rig.get("/v1/rig/files").json() == {"files": []}
    [listed] = http.get("/v1/recordings").json()["recordings"]
    assert listed["participant"] == "P017" and listed["rig"] == "Ward 1" and listed["file"] == sha256(data)
    assert http.get(listed["url"]).content == data
    [session] = http.get("/v1/participants/P017/sessions").json()["sessions"]
    assert session["verdict"] == "usable" and session["approved_by"] == "Ada" and session["recordings"] == 1
    model = http.get("/v1/rigs/Ward 1/models/m-2026-03-02-P017-0/file")
    assert model.json() == {"model_id": "m-2026-03-02-P017-0"}
    assert centre.warnings() == []


def test_what_comes_twice_is_there_once(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    told.session()
    for _ in range(3):
        told.push(rig)
    told.session(number=1)
    overlapping = rig.post("/v1/rig/items", json=told.batch(3))
    assert overlapping.json() == {"seq": 11, "hash": told.items[-1]["hash"]}
    assert counts(centre) == (11, 2)
    assert centre.row().recordings == 2


def test_a_gap_is_refused_and_the_place_to_go_on_from_is_told(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    told.session()
    assert rig.post("/v1/rig/items", json=told.batch(1, 2)).json()["seq"] == 2
    for items in (told.items[3:], told.items[2:3] + told.items[4:], told.items[2:4][::-1]):
        refused = rig.post("/v1/rig/items", json={"chain": told.chain, "items": items})
        assert (refused.status_code, refused.json()["type"]) == (409, "/problems/out-of-order")
        assert refused.json()["seq"] == 2
    assert counts(centre) == (2, 0), "of a batch all is taken, or nothing"


@pytest.mark.parametrize("field", ["body", "key", "kind", "at_utc", "file", "file_bytes", "sha256", "hash"])
def test_a_forged_item_is_refused_with_its_batch(centre: Centre, rig: httpx.Client, field: str, told: Teller) -> None:
    told.session()
    batch = copy.deepcopy(told.batch())
    forged = {
        "body": {"code": "P666"}, "key": "P666", "kind": "test", "at_utc": "2020-01-01T00:00:00Z", "file": ZEROS,
        "file_bytes": 7, "sha256": ZEROS, "hash": ZEROS,
    }  # fmt: skip
    batch["items"][2][field] = forged[field]
    refused = rig.post("/v1/rig/items", json=batch)
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/hash-differs"), refused.text
    assert counts(centre) == (0, 0)


def test_a_chain_that_does_not_follow_is_forked(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    told.session()
    told.push(rig)
    other = Teller()
    other.chain, other.items = told.chain, told.items[:4]
    other.add("participant", "P018", {"code": "P018"})  # another fifth item
    for batch in (other.batch(), other.batch(5)):
        refused = rig.post("/v1/rig/items", json=batch)
        assert (refused.status_code, refused.json()["type"]) == (409, "/problems/forked")
    assert ("Ward 1", "forked") in centre.warnings()
    assert counts(centre) == (6, 1)


def test_a_chain_begins_with_its_begin(rig: httpx.Client) -> None:
    told = Teller()
    told.items = []
    told.add("participant", "P1", {"code": "P1"})
    assert rig.post("/v1/rig/items", json=told.batch()).status_code == 422
    told = Teller()
    told.add("begin", told.chain, {"after": None})
    assert rig.post("/v1/rig/items", json=told.batch()).status_code == 422
    told = Teller()
    answer = rig.post("/v1/rig/items", json={"chain": "f" * 32, "items": told.items})
    assert answer.status_code == 409, "the first item's key is the chain's id"


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"", 400), (b"{", 400), (b"\xff\xfe", 400), (b"[]", 422), (b'{"chain": 5, "items": []}', 422),
        (b'{"chain": "x", "items": []}', 422), (b'{"chain": "x", "chain": "y", "items": []}', 400),
        (b'{"chain": "' + b"a" * 32 + b'", "items": [' + b"[" * 500 + b"]" * 500 + b"]}", 400),
        (b'{"chain": "' + b"a" * 32 + b'", "items": [1e999]}', 400), (b" " * 4_000_001, 413),
        (b'{"chain": "' + b"a" * 32 + b'", "items": [' + b"9" * 6000 + b"]}", 400),
    ],
)  # fmt: skip
def test_a_body_that_is_cut_too_long_or_no_sense_is_refused_in_one_line(
    centre: Centre, rig: httpx.Client, body: bytes, status: int
) -> None:
    refused = rig.post("/v1/rig/items", content=body)
    assert refused.status_code == status, refused.text
    assert "\n" not in refused.json()["detail"] and counts(centre) == (0, 0)


def test_at_most_500_items_are_taken_at_once(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    for number in range(500):
        told.add("participant", f"P{number}", {"code": f"P{number}"})
    assert rig.post("/v1/rig/items", json=told.batch()).status_code == 422
    assert rig.post("/v1/rig/items", json=told.batch(1, 500)).json()["seq"] == 500
    assert rig.post("/v1/rig/items", json=told.batch(501)).json()["seq"] == 501


def test_a_key_opens_its_own_rig_alone(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    told.session()
    told.push(rig)
    with centre.client(centre.key("Ward 2")) as other:
        assert other.post("/v1/rig/hello", json=told.hello(centre.clock.utc())).json()["seq"] == 0
        assert other.get("/v1/rig/files").json() == {"files": []}
        assert other.put(f"/v1/rig/files/{'a' * 64}?offset=0", content=b"x").status_code == 404
    with centre.client("stimrig_rig_nobody") as nobody:
        assert nobody.get("/v1/rig/files").status_code == 401
    with centre.client() as administrator:
        assert administrator.get("/v1/rig/files").status_code == 401


def test_a_key_that_is_revoked_ends_in_the_middle(centre: Centre, rig: httpx.Client, http: httpx.Client) -> None:
    told = Teller()
    data = told.session()
    assert rig.post("/v1/rig/items", json=told.batch(1, 4)).status_code == 200
    place = f"/v1/rig/files/{sha256(data)}"
    assert rig.put(f"{place}?offset=0", content=data[:100]).json() == {"have_bytes": 100, "whole": False}
    assert http.delete("/v1/rigs/Ward 1").status_code == 204
    answers = [
        rig.post("/v1/rig/items", json=told.batch(5)), rig.put(f"{place}?offset=100", content=data[100:]),
        rig.get("/v1/rig/files"), rig.post("/v1/rig/hello", json=told.hello(centre.clock.utc())),
    ]  # fmt: skip
    assert [answer.status_code for answer in answers] == [401] * 4
    assert counts(centre) == (4, 1), "what was pushed stays"
    with centre.client(centre.key()) as again:  # a new key for the rig: it goes on where it was
        assert again.post("/v1/rig/items", json=told.batch(5)).json()["seq"] == 6
        assert again.get("/v1/rig/files").json()["files"][0]["have_bytes"] == 100
        told.push(again)
    assert counts(centre) == (6, 1) and http.get("/v1/recordings").json()["recordings"][0]["file"] == sha256(data)


def test_the_key_is_looked_at_again_within_the_batchs_transaction(centre: Centre, rig: httpx.Client) -> None:
    row = centre.row()
    centre.context.rigs.revoke("Ward 1", "test")
    told = Teller()
    from stimrig.api.centre.ingest import read
    from stimrig.api.errors import ApiError
    from stimrig.api.outbox.messages import BatchIn

    with pytest.raises(ApiError, match="revoked"):
        centre.context.ingest.take(row, read(BatchIn, json.dumps(told.batch()).encode()))
    assert counts(centre) == (0, 0)


def test_a_rig_restored_from_its_backup_is_told_and_nothing_doubles(
    centre: Centre, rig: httpx.Client, http: httpx.Client, told: Teller
) -> None:
    told.session()
    old = copy.deepcopy(told)  # the backup
    told.session(number=1)
    told.push(rig)
    assert rig.post("/v1/rig/hello", json=old.hello(centre.clock.utc())).json()["seq"] == 11
    assert centre.warnings() == [("Ward 1", "restored")]
    fresh = Teller(after={"chain": old.chain, "seq": old.items[-1]["seq"]})
    for item in old.items[1:]:  # everything anew
        fresh.add(item["kind"], item["key"], item["body"], old.files.get(item["file"]), item["at_utc"])
    fresh.session(number=2)
    assert rig.post("/v1/rig/items", json=fresh.batch()).json()["seq"] == 11
    lacking = rig.get("/v1/rig/files").json()["files"]
    assert len(lacking) == 2, "what the centre has already is sent only once"
    fresh.push(rig)
    assert centre.warnings() == [("Ward 1", "restored")]
    assert counts(centre)[1] == 3 and centre.row().recordings == 3
    [session] = http.get("/v1/participants/P017/sessions").json()["sessions"]
    assert (session["tests"], session["recordings"]) == (3, 3)
    bodies = [row.body for row in centre.context.store.all(CentreItem) if row.kind == "recording"]
    assert len([body for body in bodies if body is not None]) == 3


def test_a_rig_that_wrote_on_after_its_restore_to_the_same_place_is_told(centre: Centre, rig: httpx.Client) -> None:
    told = Teller()
    old = copy.deepcopy(told)
    told.session()
    told.push(rig)
    for number in range(5):
        old.add("participant", f"Q{number}", {"code": f"Q{number}"})
    rig.post("/v1/rig/hello", json=old.hello(centre.clock.utc()))
    assert centre.warnings() == [("Ward 1", "restored")]


def test_a_greeting_warns_of_clock_disk_and_damage_until_it_is_over(
    centre: Centre, rig: httpx.Client, http: httpx.Client, told: Teller
) -> None:
    bad = {"disk_free_bytes": 10**9, "damaged": ["recordings/a.h5"], "state": "latched", "reason": "stop pressed"}
    rig.post("/v1/rig/hello", json=told.hello(AT, **bad))
    kinds = {"clock", "disk", "damaged-at-rig"}
    assert {kind for _rig, kind in centre.warnings()} == kinds
    for _ in range(2):
        rig.post("/v1/rig/hello", json=told.hello(AT, **bad))
    listed = http.get("/v1/warnings").json()
    assert {one["kind"] for one in listed} == kinds and [one["times"] for one in listed] == [3] * 3
    for one in listed:
        assert http.post(f"/v1/warnings/{one['id']}/acknowledge").status_code == 204
    rig.post("/v1/rig/hello", json=told.hello(AT, **bad))
    assert centre.warnings() == [], "acknowledged, and still the same"
    rig.post("/v1/rig/hello", json=told.hello(centre.clock.utc()))
    rig.post("/v1/rig/hello", json=told.hello(AT, **bad))
    assert {kind for _rig, kind in centre.warnings()} == {"clock", "disk"}, "over, and there again"


def test_a_rig_that_is_not_seen_for_a_day_is_told_once(centre: Centre, rig: httpx.Client) -> None:
    from stimrig.api.centre import check

    rig.post("/v1/rig/hello", json=Teller().hello(centre.clock.utc()))
    check.look(centre.context.spool)
    assert centre.warnings() == []
    centre.clock.later_s = 25 * 3600
    for _ in range(2):
        check.look(centre.context.spool)
    assert centre.warnings() == [("Ward 1", "unseen")]
    rig.post("/v1/rig/hello", json=Teller().hello(centre.clock.utc()))
    assert [one["ended_utc"] is not None for one in centre.client().get("/v1/warnings").json()] == [True]


def test_kinds_of_a_newer_rig_are_kept_and_shown_nowhere(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    told.add("posture", "x", {"what": "a newer version tells"})
    told.push(rig)
    assert counts(centre) == (2, 0) and centre.warnings() == []
    assert centre.context.store.all(CentreItem)[-1].body == canonical({"what": "a newer version tells"})


@pytest.mark.sqlite
def test_a_centre_restored_from_its_backup_gets_again_what_it_lost(tmp_path: Path) -> None:
    told, key = Teller(), ""
    first, second = told.session(), b""
    backup = tmp_path / "backup.db"
    for centre in run_centre(tmp_path / "centre"):
        key = centre.key()
        with centre.client(key) as rig:
            told.push(rig)
        with closing(sqlite3.connect(centre.data / "centre.db")) as there, closing(sqlite3.connect(backup)) as copied:
            there.backup(copied)
        second = told.session(number=1)
        with centre.client(key) as rig:
            told.push(rig)
    for path in (tmp_path / "centre").glob("centre.db*"):
        path.unlink()
    backup.rename(tmp_path / "centre" / "centre.db")
    for centre in run_centre(tmp_path / "centre"):
        with centre.client(key) as rig, centre.client() as http:
            greeted = rig.post("/v1/rig/hello", json=told.hello(centre.clock.utc())).json()
            assert (greeted["seq"], greeted["hash"]) == (6, told.items[5]["hash"])
            assert rig.post("/v1/rig/items", json=told.batch(7)).json()["seq"] == 11
            told.push(rig)
            listed = http.get("/v1/recordings").json()["recordings"]
            assert [http.get(one["url"]).content for one in listed] == [first, second]
        assert counts(centre) == (11, 2) and centre.warnings() == []


def test_what_was_acknowledged_keeps_no_new_warning_back(
    centre: Centre, rig: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warnings, "MOST_OPEN", 3)
    rig_id, now = centre.row().id, "2026-11-23T08:00:00.000Z"

    def flap(times: int) -> None:
        for _ in range(times):
            with centre.context.store.write() as session:
                warnings.tell(session, now, rig_id, "clock", difference_s=5.0)
                warnings.end(session, now, "clock", CentreWarning.rig_id == rig_id)

    flap(5)
    assert len(centre.warnings()) == 3
    with centre.context.store.write() as session:
        session.execute(update(CentreWarning).values(acknowledged_by="Ada", acknowledged_utc=now))
    flap(1)
    assert centre.warnings() == [("Ward 1", "clock")]
