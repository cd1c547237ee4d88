"""Uploads: what a worker dies of is refused in one line, and what is refused or left behind is cleared away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import httpx
import pytest

import stimrig
from stimrig.api.export.record_file import write_record
from stimrig.api.record_files import find_recording
from stimrig.api.store.tables import Recording
from stimrig.api.web import middleware
from stimrig.identify.records.record import Source
from tests.api.conftest import REAL, STUB, run_service, serving, soon
from tests.api.test_problems import problem
from tests.api.thread_worker import PROCESS
from tests.harness import hostile_shapes
from tests.harness.cohort_records import Session, write

pytestmark = pytest.mark.slow


UPLOAD = "/v1/participants/P017/recordings"


@pytest.mark.parametrize(("dies", "status", "says"), [("crash", 422, "SIGSEGV"), ("killed", 503, "memory runs short")])
def test_an_upload_that_a_worker_dies_of_is_refused_in_one_line(
    tmp_path: Path, short_dir: Path, dies: str, status: int, says: str
) -> None:
    """It crashes as libhdf5 might, which is the file's fault; or the system kills it, which need not be."""
    with serving(tmp_path, short_dir, PROCESS, workers=1) as (service, client):
        submit = service.context.pool.submit
        service.context.pool.submit = lambda _verb, **_given: submit("hostile", data=dies)
        client.post("/v1/participants", json={"code": "P017"})
        found = problem(client.post(UPLOAD, content=b"x"), status)
        assert says in found["detail"] and str(service.data) not in found["detail"]
        assert found["detail"].endswith("Nothing of the upload was kept.")
        assert not list((service.data / "recordings").rglob("upload-*"))


def test_the_same_samples_in_any_format_are_another_participants(tmp_path: Path, short_dir: Path) -> None:
    sealed = write(tmp_path / "s.h5", Session("P017"))
    with h5py.File(sealed, "r+") as file:
        file.attrs["current_ma"] = 20.0
    with serving(tmp_path, short_dir, REAL, workers=1) as (service, client):
        for code in ("P017", "P018"):
            assert client.post("/v1/participants", json={"code": code}).is_success
        mine = (sent := client.post(UPLOAD, content=sealed.read_bytes())).json()["recording_id"]
        with service.context.store.write() as session:  # as a recording of the rig, which was not read yet
            session.get(Recording, mine).samples_sha256 = None
        contents = [client.get(f"/v1/recordings/{mine}/csv").content]
        for kind in ("csv", "mat", "parquet"):
            write_record(replace(stimrig.read(sealed), source=Source()), tmp_path / f"r.{kind}", kind)
            contents.append((tmp_path / f"r.{kind}").read_bytes())
        for content in contents:
            refused = client.post("/v1/participants/P018/recordings", content=content)
            assert problem(refused, 409)["of"] == "P017", refused.text
        own = client.post(UPLOAD, content=contents[0])
        assert own.status_code == 201, "the person's own"
        versions = service.context.versions
        models = [versions.get(each.json()["model"]["id"]) for each in (sent, own)]
        said = ["with what current" in versions.why_not_joined(model) for model in models]
        assert said == [False, True], "a sealed file says it, a table does not"
        assert client.post("/v1/participants/P018/recordings", content=contents[0], params={"of": "P017"}).is_success


def test_an_upload_whose_client_leaves_is_given_up(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, STUB, workers=1) as (service, client):
        client.post("/v1/participants", json={"code": "P017"})
        (slow := tmp_path / "recordings" / "parts" / "fitting-slowly").touch()
        for _ in range(2):  # one is fitted, one waits
            with pytest.raises(httpx.ReadTimeout):
                client.post(UPLOAD, content=b"a,b\n", timeout=1.0)
        pool = service.context.pool
        soon(lambda: not pool.queue and not pool.workers[0].job)
        soon(lambda: not list((tmp_path / "recordings").rglob("upload-*")))
        slow.unlink()
        assert client.post(UPLOAD, content=b"a,b\n").status_code == 201


def test_too_many_uploads_at_once_are_refused_before_they_are_read(
    shared_client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(middleware, "MOST_UPLOADS", 0)
    refused = shared_client.post(UPLOAD, content=b"a,b\n")
    assert problem(refused, 503)["type"] == "/problems/crowded" and refused.headers["retry-after"] == "30"


def test_no_path_of_this_machine_is_told_of_an_upload(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, REAL, workers=1):
        with service.client() as client:
            client.post("/v1/participants", json={"code": "P017"})
            content = hostile_shapes.good(hostile_shapes.virtual_over_raw, tmp_path)
            for body in (content, b"time_s,pulse_width_us,torque_nm,segment\n1,2,x,y\n"):
                answer = client.post("/v1/participants/P017/recordings", content=body)
                problem(answer, 422)
                assert str(tmp_path) not in answer.text and "the upload" in answer.text
        assert not list((service.data / "recordings").rglob("upload-*"))


def test_a_start_with_another_database_deletes_no_upload(
    tmp_path: Path, short_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A mistyped STIMRIG_DATABASE_URL, or an older database put back, names none of the files that are there."""
    kept = ""
    with serving(tmp_path, short_dir, STUB) as (_, client):
        client.post("/v1/participants", json={"code": "P017"})
        kept = client.post("/v1/participants/P017/recordings", content=b"a,b\n").json()["recording_id"]
    folder = tmp_path / "recordings"
    names = {f"{kept}.csv", "upload-00ff.h5", "joined-00ff.csv", "20260101T000000Z_T-1.h5", "upload-notes.txt"}
    for name in names - {f"{kept}.csv"}:
        (folder / name).write_bytes(b"x")
    for _ in run_service(tmp_path, short_dir, STUB, database_url=f"sqlite:///{tmp_path}/fresh.db"):
        assert f"{kept}.csv" in caplog.text and "Is it the right database?" in caplog.text
    with serving(tmp_path, short_dir, STUB) as (_, client):
        assert client.get(f"/v1/recordings/{kept}").text == "a,b\n"
    assert {path.name for path in folder.iterdir() if path.is_file()} == names


def test_what_an_ended_service_had_begun_to_take_in_is_settled_at_the_start(tmp_path: Path, short_dir: Path) -> None:
    kept = ""
    with serving(tmp_path, short_dir, STUB) as (_, client):
        client.post("/v1/participants", json={"code": "P017"})
        kept = client.post("/v1/participants/P017/recordings", content=b"a,b\n").json()["recording_id"]
    folder, parts = tmp_path / "recordings", tmp_path / "recordings" / "parts"
    (folder / f"{kept}.csv").replace(parts / f"{kept}.csv")  # it ended right after it had written the row
    for name in ("upload-00ff.csv", "upload-00ff.h5", "joined-00ff.csv"):
        (parts / name).write_bytes(b"x")
    with serving(tmp_path, short_dir, STUB) as (_, client):
        assert client.get(f"/v1/recordings/{kept}").text == "a,b\n"
    assert not list(parts.iterdir())


def test_a_row_that_is_not_written_leaves_no_file(tmp_path: Path, short_dir: Path, monkeypatch: pytest.MonkeyPatch):
    for service in run_service(tmp_path, short_dir, STUB):
        with service.client() as client:
            client.post("/v1/participants", json={"code": "P017"})
            monkeypatch.setattr("stimrig.api.services.recordings.audit.write", Mock(side_effect=OSError("disk full")))
            assert client.post("/v1/participants/P017/recordings", content=b"a,b\n").status_code == 500
            monkeypatch.undo()
        assert not list((tmp_path / "recordings").rglob("upload-*"))


def test_an_upload_is_never_taken_for_the_recording_of_a_lost_test(tmp_path: Path) -> None:
    def named(name: str) -> dict[str, Any] | None:
        (tmp_path / name).write_bytes(hostile_shapes.good())
        return find_recording(lambda *_: None, str(tmp_path), "T-1")["found"]

    assert named("upload-00ff.h5") is None
    found = named("20260101T000000Z_T-1.h5")
    assert found is not None and found["recording_id"] == "R-1"


NOT_SOUND: list[tuple[bytes, str]] = [
    (b'{"code": "P1\xff"}', "not UTF-8"),
    (b'{"participant": "P1", "segments": [{"name": "a", "sequence": "rest", "settings": {"a": %s1%s}}]}'
     % (b'{"a":' * 900, b"}" * 900), "more than 16 brackets"),
    (b'{"code": "P1", "profile": {"current_ma": 10, "current_ma": 90}}', "'current_ma' is there twice"),
    (b'{"code": ' + b"1" * 5000 + b"}", "a number with too many digits"),
]  # fmt: skip


@pytest.mark.parametrize("path", ["/v1/participants", "/v1/tests", "/v1/preview", "/v1/sessions"])
def test_json_that_is_not_sound_is_refused(shared_client: httpx.Client, path: str) -> None:
    silent: Any = None  # it does not look first at what it decides on
    for body, says in NOT_SOUND:
        answer = shared_client.post(path, content=body, headers={"content-type": "application/json"}, auth=silent)
        assert says in problem(answer, 400)["detail"], says
    documented = shared_client.get("/openapi.json").json()["paths"][path]["post"]["responses"]
    assert {"400", "413"} <= set(documented)


def test_a_stop_is_a_stop_whatever_its_body(shared_client: httpx.Client) -> None:
    for body in (b"\xff\xff", b"[" * 900, b'{"reason": "a", "reason": "b"}'):
        answer = shared_client.post("/v1/stop", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 200, answer.text
