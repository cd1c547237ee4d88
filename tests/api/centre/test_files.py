"""Files come in piece by piece, are compared with their hashes, and are never half there under their names."""

from __future__ import annotations

import errno
import os
import stat
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import fsspec
import httpx
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from stimrig.api.centre import check
from stimrig.api.centre.bucket import Bucket, BucketError
from stimrig.api.centre.spool import MOST_PARTS, MOST_PIECE_BYTES
from stimrig.api.store.centre_tables import CentreFile, CentreItem, CentreModel, CentreWanted
from tests.api.centre.conftest import Centre, Teller, run_centre, sha256
from tests.api.conftest import PATIENCE_S, soon


class TroubledFiles(MemoryFileSystem):
    """An object store in memory that can be full, or gone."""

    protocol = "troubled"
    store: dict[str, Any] = {}  # noqa: RUF012
    pseudo_dirs = [""]  # noqa: RUF012
    trouble: OSError | None = None

    def put_file(self, *given: Any, **more: Any) -> None:
        self._refuse()
        super().put_file(*given, **more)

    def pipe_file(self, *given: Any, **more: Any) -> None:
        self._refuse()
        super().pipe_file(*given, **more)

    def _open(self, *given: Any, **more: Any) -> Any:
        if self.trouble is not None and self.trouble.errno != errno.ENOSPC:
            raise self.trouble
        return super()._open(*given, **more)

    def _refuse(self) -> None:
        if self.trouble is not None:
            raise self.trouble


@pytest.fixture
def troubled(tmp_path: Path) -> Iterator[Centre]:
    fsspec.register_implementation("troubled", TroubledFiles, clobber=True)
    TroubledFiles.trouble = None
    TroubledFiles.store.clear()
    yield from run_centre(tmp_path / "centre", files="troubled://bucket/prefix")


def whole_files(centre: Centre) -> set[str]:
    """What lies in the folder that is the bucket."""
    return {path.name for path in (centre.data / "files").glob("??/*")}


def put(rig: httpx.Client, name: str, offset: int, data: bytes) -> httpx.Response:
    return rig.put(f"/v1/rig/files/{name}?offset={offset}", content=data)


def test_a_file_is_cut_off_and_goes_on_where_it_was(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    data = os.urandom(100_000)
    name = told.add("recording", "r1", {"participant": "P1"}, data)["file"]
    rig.post("/v1/rig/items", json=told.batch())
    assert put(rig, name, 0, data[:30_000]).json() == {"have_bytes": 30_000, "whole": False}
    for offset in (0, 29_999, 30_001):
        refused = put(rig, name, offset, data[30_000:])
        assert (refused.status_code, refused.json()["have_bytes"]) == (409, 30_000)
    assert rig.get("/v1/rig/files").json()["files"] == [{"sha256": name, "bytes": 100_000, "have_bytes": 30_000}]
    assert whole_files(centre) == set()
    assert put(rig, name, 30_000, data[30_000:]).json() == {"have_bytes": 100_000, "whole": True}
    assert whole_files(centre) == {name} and list(centre.data.glob("spool/*/*.part")) == []
    assert put(rig, name, 0, data).json() == {"have_bytes": 100_000, "whole": True}, "once more: it is there"


def test_a_forged_file_is_thrown_away(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    name = told.add("recording", "r1", {"participant": "P1"}, b"what was sealed")["file"]
    rig.post("/v1/rig/items", json=told.batch())
    for forged in (b"what was forged", b"what was sealed, and more"):
        refused = put(rig, name, 0, forged)
        assert (refused.status_code, refused.json()["type"]) == (422, "/problems/hash-differs")
        assert rig.get("/v1/rig/files").json()["files"][0]["have_bytes"] == 0
    assert put(rig, sha256(b"nobody named it"), 0, b"nobody named it").status_code == 404
    assert rig.put("/v1/rig/files/..%2f..%2fetc?offset=0", content=b"x").status_code in (404, 422)
    assert rig.put(f"/v1/rig/files/{name}?offset=-1", content=b"x").status_code == 422
    assert rig.put(f"/v1/rig/files/{name}?offset=0", content=b"x" * (MOST_PIECE_BYTES + 1)).status_code == 413
    assert whole_files(centre) == set()
    assert put(rig, name, 0, b"what was sealed").json()["whole"] is True


def test_an_empty_file_is_a_file(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    name = told.add("recording", "r1", {"participant": "P1"}, b"")["file"]
    told.push(rig)
    assert whole_files(centre) == {name}


def test_the_same_file_of_two_rigs_is_kept_once_and_no_rig_spoils_anothers(
    centre: Centre, rig: httpx.Client, http: httpx.Client
) -> None:
    one, two = Teller(), Teller()
    data = one.session()
    assert two.session() == data
    with centre.client(centre.key("Ward 2")) as other:
        for teller, client in ((one, rig), (two, other)):
            client.post("/v1/rig/items", json=teller.batch())
        name = sha256(data)
        assert put(other, name, 0, b"X" * 20).json()["have_bytes"] == 20
        assert put(rig, name, 0, data).json()["whole"] is True
        assert name not in {one["sha256"] for one in other.get("/v1/rig/files").json()["files"]}
        two.push(other)
    assert len(whole_files(centre)) == 2 and name in whole_files(centre)
    listed = http.get("/v1/recordings").json()["recordings"]
    assert [(one["rig"], one["file"]) for one in listed] == [("Ward 1", name), ("Ward 2", name)]
    assert {http.get(one["url"]).content for one in listed} == {data}
    check.look(centre.context.spool)
    assert list(centre.data.glob("spool/*/*.part")) == [], "what nobody waits for is thrown away"


def test_so_many_parts_of_a_rig_and_no_more(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    names = [told.add("recording", f"r{n}", {"participant": "P1"}, b"%03d" % n)["file"] for n in range(MOST_PARTS + 4)]
    rig.post("/v1/rig/items", json=told.batch())
    for number, name in enumerate(names):
        assert put(rig, name, 0, (b"%03d" % number)[:1]).status_code == 200
    assert len(list(centre.data.glob("spool/*/*.part"))) <= MOST_PARTS
    told.push(rig)
    assert whole_files(centre) == set(names)


def test_so_many_bytes_of_a_rigs_parts_and_no_more(
    centre: Centre, rig: httpx.Client, monkeypatch: pytest.MonkeyPatch, told: Teller
) -> None:
    """A rig that begins one large file after the other fills no disk of the centre."""
    monkeypatch.setattr("stimrig.api.centre.spool.MOST_BYTES", 50)
    data = [b"%03d" % n * 10 for n in range(6)]
    names = [told.add("recording", f"r{n}", {"participant": "P1"}, one)["file"] for n, one in enumerate(data)]
    rig.post("/v1/rig/items", json=told.batch())
    for name, one in zip(names, data, strict=True):
        assert put(rig, name, 0, one[:20]).json()["have_bytes"] == 20
    assert sum(path.stat().st_size for path in centre.data.glob("spool/*/*.part")) <= 50 + 20
    told.push(rig)
    assert whole_files(centre) == set(names)


@pytest.mark.parametrize("trouble", [errno.ENOSPC, errno.EIO])
def test_a_bucket_that_is_full_or_gone_loses_nothing(troubled: Centre, trouble: int, told: Teller) -> None:
    data = told.session()
    with troubled.client(troubled.key()) as rig, troubled.client() as http:
        rig.post("/v1/rig/items", json=told.batch())
        TroubledFiles.trouble = OSError(trouble, os.strerror(trouble))
        refused = put(rig, sha256(data), 0, data)
        assert (refused.status_code, refused.json()["type"]) == (507, "/problems/bucket-failed")
        assert os.strerror(trouble) in refused.json()["detail"] and "\n" not in refused.json()["detail"]
        told.session(number=1)
        assert rig.post("/v1/rig/items", json=told.batch()).json()["seq"] == 11, "items are taken all the same"
        check.look(troubled.context.spool)
        assert (None, "bucket") in troubled.warnings()
        assert http.get("/health").json()["status"] == "degraded"
        lacking = rig.get("/v1/rig/files").json()["files"]
        assert lacking[0] == {"sha256": sha256(data), "bytes": len(data), "have_bytes": len(data)}, "it is kept here"
        assert not troubled.context.store.all(CentreFile)
        TroubledFiles.trouble = None
        check.look(troubled.context.spool)  # by itself, also if the rig does not come back
        assert len(rig.get("/v1/rig/files").json()["files"]) == 3
        told.push(rig)
        assert http.get("/health").json()["status"] == "ok"
        assert [one["ended_utc"] is None for one in http.get("/v1/warnings").json()] == [False]
        recording = http.get("/v1/recordings").json()["recordings"][0]
        assert http.get(recording["url"]).content == data
        TroubledFiles.trouble = OSError(errno.EIO, "gone")
        assert http.get(recording["url"]).status_code == 503


def test_a_rig_goes_on_with_a_file_that_only_waits_for_the_bucket(troubled: Centre, told: Teller) -> None:
    data = told.session()
    with troubled.client(troubled.key()) as rig:
        rig.post("/v1/rig/items", json=told.batch())
        TroubledFiles.trouble = OSError(errno.ENOSPC, "full")
        assert put(rig, sha256(data), 0, data).status_code == 507
        assert put(rig, sha256(data), 0, data).json()["have_bytes"] == len(data)
        assert put(rig, sha256(data), len(data), b"").status_code == 507
        TroubledFiles.trouble = None
        assert put(rig, sha256(data), len(data), b"").json() == {"have_bytes": len(data), "whole": True}


def test_a_folder_that_is_not_mounted_any_more_takes_nothing(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    data = told.session()
    rig.post("/v1/rig/items", json=told.batch())
    bucket = centre.data / "files"
    bucket.rename(centre.data / "elsewhere")
    for _ in range(2):
        refused = rig.put(f"/v1/rig/files/{sha256(data)}?offset=0", content=data)
        assert refused.status_code in (507, 409)
        bucket.mkdir(exist_ok=True)  # the place where it was mounted
    assert list(bucket.iterdir()) == []
    check.look(centre.context.spool)
    assert (None, "bucket") in centre.warnings()


def kept(rig: httpx.Client, http: httpx.Client) -> tuple[Teller, bytes, dict[str, Any]]:
    """A session at the centre: its recording's bytes, and how it is listed."""
    told = Teller()
    data = told.session()
    told.push(rig)
    [recording] = http.get("/v1/recordings").json()["recordings"]
    return told, data, recording


def test_a_folder_that_is_not_mounted_is_no_damage_of_its_files(centre: Centre, rig: httpx.Client, http: httpx.Client):
    _, data, recording = kept(rig, http)
    bucket, elsewhere, context = centre.data / "files", centre.data / "elsewhere", centre.context
    bucket.rename(elsewhere)
    bucket.mkdir()  # the place where it was mounted
    refused = http.get(recording["url"])
    assert (refused.status_code, refused.json()["type"]) == (503, "/problems/bucket-failed")
    assert "not mounted" in refused.json()["detail"] and http.get("/health").json()["files"] == "failed"
    with pytest.raises(BucketError, match="not mounted"):
        next(check.check(context.store, context.bucket, context.clock, "2099-01-01T00:00:00Z"))
    assert not [kind for _, kind in centre.warnings() if kind == "damaged"] and not context.store.all(CentreWanted)
    bucket.rmdir()
    elsewhere.rename(bucket)
    assert http.get(recording["url"]).content == data


def test_a_file_that_was_changed_is_refused_told_and_asked_for_again(
    centre: Centre, rig: httpx.Client, http: httpx.Client
) -> None:
    told, data, recording = kept(rig, http)
    name = sha256(data)
    place = centre.data / "files" / name[:2] / name
    for damage in (lambda: place.write_bytes(b"X" + data[1:]), place.unlink):
        damage()
        refused = http.get(recording["url"])
        assert (refused.status_code, refused.json()["type"]) == (500, "/problems/file-damaged")
        assert ("Ward 1", "damaged") in centre.warnings()
        assert [one["sha256"] for one in rig.get("/v1/rig/files").json()["files"]] == [name]
        told.push(rig)
        assert http.get(recording["url"]).content == data, "the rig has sent it again"
        told_of = [one for one in http.get("/v1/warnings").json() if one["kind"] == "damaged"]
        assert told_of and all(one["ended_utc"] for one in told_of), "and the warning says so"


def test_check_reads_every_file_and_goes_on_where_it_was_cut(centre: Centre, rig: httpx.Client, told: Teller) -> None:
    for number in range(6):
        told.session(number=number)
    told.push(rig)
    context = centre.context
    name = sorted(whole_files(centre))[3]
    (centre.data / "files" / name[:2] / name).write_bytes(b"damaged")
    centre.clock.later_s = 10.0
    begun = context.clock.utc()
    run = check.check(context.store, context.bucket, context.clock, begun)
    first = [next(run) for _ in range(5)]
    run.close()
    rest = list(check.check(context.store, context.bucket, context.clock, begun))
    assert len(first) + len(rest) == 12 and not {one.sha256 for one in first} & {one.sha256 for one in rest}
    assert [one.sha256 for one in [*first, *rest] if not one.ok] == [name]
    assert [row.sha256 for row in context.store.all(CentreWanted)] == [name]


def test_a_model_that_is_told_with_another_file_keeps_its_first(centre: Centre, rig: httpx.Client) -> None:
    told = Teller()
    for data in (b"first", b"other"):
        told.add("model", "m1", {"participant": "P1", "recording_id": "r1", "fit": {}}, data)
    assert rig.post("/v1/rig/items", json=told.batch()).status_code == 200
    assert [row.file for row in centre.context.store.all(CentreModel)] == [sha256(b"first")]
    assert ("Ward 1", "changed") in centre.warnings()


def test_a_file_that_is_too_long_is_not_asked_for(tmp_path: Path) -> None:
    for centre in run_centre(tmp_path, max_file_mb=0.001):
        told = Teller()
        told.add("recording", "r1", {"participant": "P1"}, b"x" * 1001)
        told.add("recording", "r2", {"participant": "P1"}, b"x" * 1000)
        with centre.client(centre.key()) as rig:
            told.push(rig)
        assert centre.warnings() == [("Ward 1", "too-long")]
        assert len(whole_files(centre)) == 1 and len(centre.context.store.all(CentreItem)) == 3


def test_a_copy_that_is_cut_off_leaves_nothing_under_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bucket = Bucket(str(tmp_path / "files"))
    (tmp_path / "files").mkdir()
    bucket.ready(begin=True)
    source = tmp_path / "source"
    source.write_bytes(b"x" * 100)
    monkeypatch.setattr(os, "fsync", lambda _file: (_ for _ in ()).throw(OSError(errno.EIO, "pulled out")))
    with pytest.raises(Exception, match="pulled out"):
        bucket.put(source, sha256(b"x" * 100))
    assert not [path for path in (tmp_path / "files").rglob("*") if path.is_file() and path.name != "stimrig-centre"]


def test_a_copy_whose_name_may_be_lost_again_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bucket = Bucket(str(tmp_path / "files"))
    (tmp_path / "files").mkdir()
    bucket.ready(begin=True)
    (tmp_path / "source").write_bytes(b"x" * 100)
    synced = os.fsync

    def of_files(file: int) -> None:
        if stat.S_ISDIR(os.fstat(file).st_mode):
            raise OSError(errno.EIO, "pulled out")
        synced(file)

    monkeypatch.setattr(os, "fsync", of_files)
    with pytest.raises(Exception, match="pulled out"):
        bucket.put(tmp_path / "source", sha256(b"x" * 100))


def test_on_s3(tmp_path: Path, s3: Any) -> None:
    s3.mkdir("trial")
    for centre in run_centre(tmp_path, files="s3://trial/centre"):
        told = Teller()
        data = told.session()
        with centre.client(centre.key()) as rig, centre.client() as http:
            told.push(rig)
            [recording] = http.get("/v1/recordings").json()["recordings"]
            assert http.get(recording["url"]).content == data
            name = sha256(data)
            s3.pipe(f"trial/centre/{name[:2]}/{name}", b"changed")
            assert http.get(recording["url"]).json()["type"] == "/problems/file-damaged"


def test_a_bucket_that_does_not_answer_keeps_neither_items_nor_pages_waiting(
    centre: Centre, monkeypatch: pytest.MonkeyPatch
) -> None:
    holding, let_go = threading.Semaphore(0), threading.Event()

    def held(*_given: Any) -> None:
        holding.release()
        assert let_go.wait(PATIENCE_S)

    monkeypatch.setattr(centre.context.bucket, "put", held)
    keys, rigs = [centre.key(f"Ward {number}") for number in range(12)], []
    for key in keys:
        told = Teller()
        told.session()
        rig = centre.client(key)
        assert rig.post("/v1/rig/items", json=told.batch()).status_code == 200
        rigs.append((rig, told))

    def send(of: tuple[httpx.Client, Teller], file: int) -> int:
        rig, told = of
        name, data = list(told.files.items())[file]
        return rig.put(f"/v1/rig/files/{name}?offset=0", content=data).status_code

    with ThreadPoolExecutor(40) as threads:
        sent = [threads.submit(send, of, file) for of in rigs for file in (0, 1, 0)]
        try:
            assert holding.acquire(timeout=PATIENCE_S)
            soon(lambda: sum(centre.context.putting.values()) >= len(sent))
            rig, told = rigs[0]
            assert rig.post("/v1/rig/hello", json=told.hello("2026-03-02T08:00:00Z")).status_code == 200
            assert send(rigs[0], 0) == 503, "three of this rig are under way"
            with centre.client() as http:
                assert http.get("/").status_code == 200 and http.get("/participants").status_code == 200
        finally:
            let_go.set()
        assert {future.result() for future in sent} <= {200, 409}
    for rig, _told in rigs:
        rig.close()
