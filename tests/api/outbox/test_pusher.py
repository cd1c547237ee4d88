"""The pusher on a virtual clock, with a centre written from decision 0013: nothing lost, nothing doubled, in order."""

from __future__ import annotations

import contextlib
import json
import random
import shutil
import sqlite3
import tracemalloc
from collections import Counter
from pathlib import Path
from unittest.mock import Mock

import httpx
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from sqlalchemy.exc import OperationalError

from stimrig.api.outbox import status
from stimrig.api.outbox.files import CHUNK
from stimrig.api.outbox.pusher import HELLO_S, REVOKED_S
from stimrig.api.store import audit
from stimrig.api.store.tables import AuditEntry, Participant, Recording
from tests.api.outbox.conftest import Rig, assert_chain, assert_told, run, sha256
from tests.harness.fake_centre import KEY, RUBBISH, BadLine, FakeCentre


@pytest.fixture
def centre() -> FakeCentre:
    return FakeCentre()


def state_of(rig: Rig) -> status.Status:
    told = status.read(rig.settings, rig.clock.unix_s())
    assert told is not None
    return told


def test_everything_comes_over_and_what_is_new_within_two_seconds(rig: Rig, centre: FakeCentre) -> None:
    rig.tracked(rig.session("P1"))
    pusher = rig.pusher(centre.handle)
    run(pusher, 3)
    assert_told(rig, centre)
    rig.session("P1")
    run(pusher, 2)
    assert_told(rig, centre)
    assert state_of(rig).state == "current" and state_of(rig).items_waiting == state_of(rig).files_waiting == 0


def test_hello_says_how_the_rig_is(rig: Rig, centre: FakeCentre) -> None:
    rig.participant("P1")
    run(rig.pusher(centre.handle), 95)
    assert len(centre.hellos) == 4, "at the start and every 30 s"
    said = centre.hellos[-1]
    newest = rig.items()[-1]
    assert (said["chain"], said["seq"], said["hash"]) == (newest.chain, newest.seq, newest.hash)
    assert said["disk_total_bytes"] >= said["disk_free_bytes"] > 0 and said["version"] and said["utc"].endswith("Z")
    assert (said["state"], said["reason"], said["damaged"]) == (None, None, [])
    assert (said["waiting_items"], said["waiting_files"]) == (0, 0)


def test_an_empty_rig_says_hello(rig: Rig, centre: FakeCentre) -> None:
    run(rig.pusher(centre.handle), 3)
    assert_told(rig, centre)
    assert rig.told() == [("begin", rig.items()[0].chain)]


def test_what_came_about_without_a_centre_is_told(tmp_path: Path, centre: FakeCentre) -> None:
    rig = Rig(tmp_path, feed=False)
    for _ in range(3):
        rig.session("P1")
    run(rig.pusher(centre.handle), 5)
    assert_told(rig, centre)
    assert len(centre.newest("recording")) == 3 and len(centre.newest("model")) == 3
    rig.close()


@pytest.mark.slow
@pytest.mark.parametrize("rubbish", [False, True], ids=["line", "rubbish"])
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(2, 6))])
def test_whatever_the_line_does_all_comes_over(tmp_path: Path, seed: int, rubbish: bool) -> None:
    """Answers dropped, bodies cut, answered twice, restored from an older state, rubbish: at the end all is there."""
    rig, line = Rig(tmp_path, seed=seed), BadLine(FakeCentre(), random.Random(seed), 0.6, rubbish)
    pusher = rig.pusher(line, seed)
    for _ in range(12):
        rig.session("P1", size=rig.chance.randrange(5_000))
        run(pusher, rig.chance.choice((1.0, 10.0, 600.0)))
    assert line.requests > 20
    line.harm = 0.0
    run(pusher, 3 * REVOKED_S)
    assert_told(rig, line.centre)
    assert len(line.centre.newest("recording")) == 12 and state_of(rig).state == "current"
    assert len(line.centre.chains) == 1, "nothing that a bad line does looks like a restored rig"
    rig.close()


STEPS = ("session", "participant", "wait", "long wait", "new pusher", "backup", "older")


@pytest.mark.slow
@hypothesis_settings(max_examples=12)
@given(st.lists(st.sampled_from(STEPS), max_size=12), st.integers(0, 2**32), st.sampled_from((0.0, 0.3, 0.8)))
def test_in_any_order_of_work_failures_and_restarts(
    tmp_path_factory: pytest.TempPathFactory, steps: list[str], seed: int, harm: float
) -> None:
    rig = Rig(tmp_path_factory.mktemp("rig"), seed=seed)
    centre = FakeCentre()
    line = BadLine(centre, random.Random(seed), harm)
    pusher, backups, codes = rig.pusher(line, seed), [centre.backup()], ["P0"]
    rig.participant("P0")
    for number, step in enumerate(steps, 1):
        if step == "session":
            rig.session(rig.chance.choice(codes), size=rig.chance.randrange(300))
        elif step == "participant":
            codes.append(f"P{number}")
            rig.participant(codes[-1])
        elif step == "new pusher":
            pusher = rig.pusher(line, seed + number)
        elif step == "backup":
            backups.append(centre.backup())
        elif step == "older":
            centre.restore(rig.chance.choice(backups))
        else:
            run(pusher, 2.0 if step == "wait" else 700.0)
    line.harm = 0.0
    run(pusher, 700)
    assert_told(rig, centre)
    rig.close()


# ---- files --------------------------------------------------------------------------------------------------------


def test_a_large_recording_goes_over_in_chunks_and_each_byte_once(rig: Rig, centre: FakeCentre) -> None:
    row = rig.recording("P1", size=2 * CHUNK + 12345)
    sizes: list[int] = []

    def line(request: httpx.Request) -> httpx.Response:
        if request.method == "PUT":
            sizes.append(int(request.headers["Content-Length"]))
            if len(sizes) == 2:
                raise httpx.ReadError("cut")
        return centre.handle(request)

    pusher = rig.pusher(line)
    run(pusher, 30)
    assert_told(rig, centre)
    assert centre.taken == 2 * CHUNK + 12345 and sizes[0] == CHUNK
    assert sizes[2] < CHUNK, "smaller ones on a line that breaks"
    assert centre.files[row.file_sha256] == Path(row.path).read_bytes()


def test_memory_is_bounded_whatever_a_recording_is_long(rig: Rig, centre: FakeCentre) -> None:
    rig.participant("P1")
    path = rig.folder / "recordings" / "long.h5"
    path.write_bytes(b"\0" * 40_000_000)
    digest = sha256(path.read_bytes())
    rig.add(Recording(id="R9", participant="P1", path=str(path), file_sha256=digest, created_utc=rig.now))
    got = 0

    class Piecewise(httpx.BaseTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            nonlocal got
            if request.method != "PUT":
                return centre.handle(request)
            assert isinstance(request.stream, httpx.SyncByteStream)
            got += sum(len(piece) for piece in request.stream)
            return httpx.Response(200, json={"have_bytes": got, "whole": got == 40_000_000})

    pusher = rig.pusher(Piecewise())
    tracemalloc.start()
    run(pusher, 5)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert got == 40_000_000 and peak < 4_000_000


def test_a_damaged_or_missing_recording_is_told_and_the_others_go_on(rig: Rig, centre: FakeCentre) -> None:
    rows = [rig.recording("P1") for _ in range(4)]
    changed, gone = Path(rows[0].path), Path(rows[2].path)
    whole = changed.read_bytes()
    changed.write_bytes(whole[:-1] + b"?")
    gone.unlink()
    pusher = rig.pusher(centre.handle)
    run(pusher, 2 * HELLO_S + 5)
    assert set(centre.files) == {rows[1].file_sha256, rows[3].file_sha256}
    assert centre.hellos[-1]["damaged"] == sorted([rows[0].file_sha256, rows[2].file_sha256])
    assert state_of(rig).state == "damaged" and state_of(rig).damaged_count == 2
    changed.write_bytes(whole)
    run(pusher, 2 * HELLO_S + 5)
    assert rows[0].file_sha256 in centre.files and centre.hellos[-1]["damaged"] == [rows[2].file_sha256]


def test_more_damaged_files_than_a_centre_lists_at_once_keep_none_back(rig: Rig, centre: FakeCentre) -> None:
    rig.participant("P1")
    for _ in range(120):
        Path(rig.recording("P1", size=10).path).unlink()
    good = rig.recording("P1", size=10)
    run(rig.pusher(centre.handle), 3 * HELLO_S)
    assert set(centre.files) == {good.file_sha256} and state_of(rig).damaged_count == 120


def test_a_file_that_changes_while_it_is_sent_is_not_believed(rig: Rig, centre: FakeCentre) -> None:
    row = rig.recording("P1", size=CHUNK + 1000)
    path = Path(row.path)

    def line(request: httpx.Request) -> httpx.Response:
        answered = centre.handle(request)
        if request.method == "PUT":
            path.write_bytes(b"other" * 2_000_000)
        return answered

    run(rig.pusher(line), 2 * HELLO_S)
    assert row.file_sha256 not in centre.files
    assert centre.hellos[-1]["damaged"] == [row.file_sha256]


def test_what_arrived_damaged_is_sent_again(rig: Rig, centre: FakeCentre) -> None:
    row = rig.recording("P1", size=1000)
    centre.parts[row.file_sha256] = b"not what was sent"
    run(rig.pusher(centre.handle), 60)
    assert centre.files[row.file_sha256] == Path(row.path).read_bytes()


def test_a_bucket_that_is_full_keeps_no_item_back(rig: Rig, centre: FakeCentre) -> None:
    centre.bucket_full = True
    rig.session("P1")
    pusher = rig.pusher(centre.handle)
    run(pusher, 10)
    rig.session("P1")
    run(pusher, 120)
    assert centre.files == {} and len(centre.newest("recording")) == 2
    assert state_of(rig).state == "bucket-failed" and "bucket is full or gone" in state_of(rig).detail
    assert state_of(rig).files_waiting > 0
    centre.bucket_full = False
    run(pusher, 700)
    assert_told(rig, centre)
    assert state_of(rig).state == "current"


# ---- what is wrong ------------------------------------------------------------------------------------------------


def test_a_revoked_key_is_said_and_seldom_tried_until_there_is_a_new_one(rig: Rig, centre: FakeCentre) -> None:
    rig.participant("P1")
    line = BadLine(centre, random.Random(1))
    pusher = rig.pusher(line)
    run(pusher, 5)
    centre.keys.clear()
    rig.session("P1")
    run(pusher, 10)
    asked = line.requests
    assert state_of(rig).state == "key-refused" and "key revoked" in state_of(rig).detail
    run(pusher, 8 * REVOKED_S)
    assert 4 <= line.requests - asked <= 14
    centre.keys.add(KEY)
    run(pusher, REVOKED_S)
    assert_told(rig, centre)


@pytest.mark.parametrize("number", range(len(RUBBISH)))
def test_a_wrong_answer_is_one_line_and_changes_nothing(rig: Rig, centre: FakeCentre, number: int) -> None:
    rig.participant("P1")
    before = rig.told()
    requests = 0

    def line(_request: httpx.Request) -> httpx.Response:
        nonlocal requests
        requests += 1
        return RUBBISH[number]()

    pusher = rig.pusher(line)
    run(pusher, 1800)
    told = state_of(rig)
    assert told.state in ("wrong-answer", "refused") and "\n" not in told.detail and len(told.detail) < 400
    assert rig.told() == before and requests < 40, "it waits longer and longer"


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(RUBBISH)))
@pytest.mark.parametrize("path", ["items", "files"])
def test_rubbish_for_some_requests_only(rig: Rig, centre: FakeCentre, number: int, path: str) -> None:
    """The centre answers hello as it should, but one thing never: nothing is lost, and it is not asked without end."""
    rig.session("P1")
    chains = {item.chain for item in rig.items()}
    requests, broken = 0, True

    def line(request: httpx.Request) -> httpx.Response:
        nonlocal requests
        requests += 1
        return RUBBISH[number]() if broken and path in request.url.path else centre.handle(request)

    pusher = rig.pusher(line)
    run(pusher, 300)
    assert requests < 60 and state_of(rig).state in ("wrong-answer", "refused")
    broken = False
    run(pusher, 700)
    assert_told(rig, centre)
    assert {item.chain for item in rig.items()} == chains


@pytest.mark.slow
def test_days_without_a_network_wait_in_the_database(rig: Rig, centre: FakeCentre) -> None:
    """4000 items wait; they go over in batches, with little memory."""
    rig.participant("P1")
    with rig.store.write() as session:
        for number in range(4000):
            session.add(Participant(code=f"C{number}", profile={"a": "x" * 200}, created_utc=rig.now, created_by="A"))
    requests = 0

    def down(_request: httpx.Request) -> httpx.Response:
        nonlocal requests
        requests += 1
        raise httpx.ConnectError("no route to host")

    pusher = rig.pusher(down)
    run(pusher, 30_000)
    assert requests < 30_000 / 140, "at most every 5 min, by chance up to half sooner"
    assert state_of(rig).state == "unreachable" and state_of(rig).items_waiting == 4003
    taken = Counter[str]()

    def up(request: httpx.Request) -> httpx.Response:  # keeps the last hash only: what is measured is the pusher
        if not request.url.path.endswith("items"):
            return centre.handle(request)
        items = json.loads(request.read())["items"]
        taken.update(item["kind"] for item in items)
        centre.chains[json.loads(request.read())["chain"]] = [items[-1]]
        return httpx.Response(200, json={"seq": items[-1]["seq"], "hash": items[-1]["hash"]})

    again = rig.pusher(up)
    tracemalloc.start()
    run(again, 30)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert taken["participant"] == 4001 and state_of(rig).items_waiting == 0
    assert peak < 25_000_000


def test_a_stopped_pusher_is_seen(rig: Rig, centre: FakeCentre) -> None:
    assert state_of(rig).state == "not-running"
    run(rig.pusher(centre.handle), 5)
    assert state_of(rig).state == "current"
    rig.clock.sleep(3600)
    assert state_of(rig).state == "not-running"
    (rig.folder / status.NAME).write_text('{"state": "current"')
    assert state_of(rig).state == "not-running"


# ---- restored -----------------------------------------------------------------------------------------------------


def restored(rig: Rig, saved: Path) -> Rig:
    """The rig with the database of the backup; recordings that were made since lie about unnamed."""
    rig.close()
    for beside in ("-wal", "-shm"):
        (rig.folder / f"stimrig.db{beside}").unlink(missing_ok=True)
    shutil.copy(saved, rig.folder / "stimrig.db")
    again = Rig(rig.folder, seed=99)
    again.clock.now_s, again.number = rig.clock.now_s, 500
    return again


@pytest.mark.parametrize("sessions_after", [0, 1, 2, 3], ids=["nothing-new", "less", "as-much", "more"])
def test_a_restored_rig_begins_anew_and_tells_everything_again(
    rig: Rig, centre: FakeCentre, tmp_path: Path, sessions_after: int
) -> None:
    if rig.store.engine.dialect.name != "sqlite":
        pytest.skip("the backup is SQLite's")
    rig.session("P1")
    run(rig.pusher(centre.handle), 5)
    with contextlib.closing(sqlite3.connect(rig.folder / "stimrig.db")) as connection:
        connection.execute(f"VACUUM INTO '{tmp_path}/backup.db'")
    for _ in range(2):
        rig.session("P1")
    run(rig.pusher(centre.handle), 5)
    taken = centre.taken
    rig = restored(rig, tmp_path / "backup.db")
    for _ in range(sessions_after):
        rig.session("P1")
    old = rig.items()[-1]
    run(rig.pusher(centre.handle), 60)
    items = [item for item in rig.items() if item.chain != old.chain]
    assert items and json.loads(items[0].body) == {"after": {"chain": old.chain, "seq": old.seq}}
    assert {item.chain for item in items} == {items[0].chain}, "anew once"
    assert_chain(centre.chains[items[0].chain])
    assert [item["hash"] for item in centre.chains[items[0].chain]] == [item.hash for item in items]
    assert {item.key for item in items if item.kind == "recording"} == {row.id for row in rig.store.all(Recording)}
    entries = [row for row in rig.store.all(AuditEntry) if row.action == "begin outbox anew"]
    assert len(entries) == 1 and audit.first_broken(rig.store.all(AuditEntry, order=AuditEntry.seq)) is None
    assert len(centre.newest("recording")) == 3 + sessions_after, "what the rig has lost is still at the centre"
    new = sum(len(data) for data in centre.files.values()) - taken
    assert centre.taken == taken + new, "what the centre had is not sent again"
    rig.close()


@pytest.mark.slow
def test_a_centre_that_is_always_ahead_makes_no_chain_after_chain(rig: Rig, centre: FakeCentre) -> None:
    rig.participant("P1")

    def line(request: httpx.Request) -> httpx.Response:
        request.read()
        if request.url.path.endswith("hello"):
            return httpx.Response(200, json={"seq": 10**6, "hash": "a" * 64})
        return centre.handle(request)

    run(rig.pusher(line), 3000)
    assert len({item.chain for item in rig.items()}) == 2
    assert state_of(rig).state == "wrong-answer" and "another rig's key" in state_of(rig).detail
    run(rig.pusher(line), 6 * 3600)
    assert len({item.chain for item in rig.items()}) <= 9


def test_a_pusher_whose_database_was_replaced_ends(rig: Rig, centre: FakeCentre, tmp_path: Path) -> None:
    """What it has open is the old one: it would tell nothing new for ever. Whoever started it starts it again."""
    if rig.store.engine.dialect.name != "sqlite":
        pytest.skip("no file is replaced")
    rig.participant("P1")

    def line(request: httpx.Request) -> httpx.Response:
        if len(centre.hellos) == 2:
            (tmp_path / "new.db").touch()
            (tmp_path / "new.db").replace(tmp_path / "stimrig.db")
        return centre.handle(request)

    rig.pusher(line).run()
    assert len(centre.hellos) >= 2


def test_a_database_that_fails_is_said_and_tried_again(rig: Rig, centre: FakeCentre, monkeypatch: pytest.MonkeyPatch):
    rig.participant("P1")
    pusher = rig.pusher(centre.handle)
    run(pusher, 5)
    with monkeypatch.context() as patch:
        patch.setattr(rig.store, "read", Mock(side_effect=OperationalError("SELECT 1", {}, OSError("disk I/O error"))))
        run(pusher, 120)
        assert state_of(rig).state == "database" and "disk I/O error" in state_of(rig).detail
    rig.session("P1")
    run(pusher, 400)
    assert_told(rig, centre)
    assert state_of(rig).state == "current"


def test_a_centre_that_was_restored_gets_again_what_it_lost(rig: Rig, centre: FakeCentre) -> None:
    rig.session("P1")
    pusher = rig.pusher(centre.handle)
    run(pusher, 5)
    saved = centre.backup()
    for _ in range(3):
        rig.session("P1")
    run(pusher, 5)
    centre.restore(saved)
    run(pusher, HELLO_S + 5)
    assert_told(rig, centre)
    assert len({item.chain for item in rig.items()}) == 1
