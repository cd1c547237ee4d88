"""A centre lets go of a participant: rows, what items said, files; and of nobody else."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest

from stimrig.api.centre import bucket as buckets
from stimrig.api.centre.bucket import Bucket, BucketError
from stimrig.api.cli import main
from stimrig.api.store.audit import first_broken
from stimrig.api.store.centre_tables import CentreItem
from stimrig.api.store.tables import AuditEntry, Erasure
from tests.api.centre.conftest import Centre, Teller

CODE = "XQ7ZZ81"


def asked(centre: Centre, code: str = CODE) -> list[str]:
    return ["centre", "erase", code, "--reason", "asked by letter", "--data", str(centre.data)]


def files(centre: Centre) -> set[str]:
    return {path.name for path in (centre.data / "files").rglob("*") if len(path.name) == 64}


def test_it_lets_go_of_one_and_keeps_the_others(centre: Centre, rig: httpx.Client, http: httpx.Client) -> None:
    told = Teller()
    for day in (2, 3):
        told.session(CODE, f"2026-03-0{day}")
        told.session("P017", f"2026-03-0{day}")
    body = {"id": "r-both", "participant": "P017", "created_utc": "2026-03-04T08:00:00.000Z"}
    shared = told.add("recording", "r-both", body, told.files[told.items[2]["file"]])
    told.push(rig)
    before = http.get("/v1/participants/P017/sessions").json()
    assert http.get(f"/v1/participants/{CODE}/sessions").status_code == 200 and len(files(centre)) == 8
    assert main.run(asked(centre)) == 0
    assert http.get(f"/v1/participants/{CODE}/sessions").status_code == 404
    assert http.get("/v1/participants/P017/sessions").json() == before
    assert len(files(centre)) == 5 and shared["file"] in files(centre), "one that another's item names stays"
    store = centre.app.state.context.store
    assert CODE not in json.dumps([row.as_dict() for row in store.all(CentreItem)])
    assert first_broken(store.all(AuditEntry, order=AuditEntry.seq)) is None
    assert main.run(["centre", "check", "--data", str(centre.data)]) == 0
    told.session("P018", "2026-03-05")
    told.push(rig)  # the chain goes on where it was
    assert http.get("/v1/participants/P018/sessions").status_code == 200
    assert main.run(asked(centre)) == 2


def test_a_code_of_two_rigs_is_erased_only_where_both_are_meant(
    centre: Centre, rig: httpx.Client, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two clinics may have given it to two people."""
    first, second = Teller(), Teller()
    first.session(CODE)
    first.push(rig)
    second.session(CODE, "2026-03-09")
    with centre.client(centre.key("Hospital B")) as other:
        second.push(other)
    kept = files(centre)
    assert main.run(asked(centre)) == 2
    told = capsys.readouterr().err
    assert "Hospital B" in told and "--all-rigs" in told and files(centre) == kept
    assert main.run([*asked(centre), "--all-rigs"]) == 0 and files(centre) == set()


def test_a_code_that_differs_by_its_case_is_another_person(
    centre: Centre, rig: httpx.Client, http: httpx.Client
) -> None:
    """SQLite's LIKE takes both for the same."""
    told, other = Teller(), CODE.lower()
    told.session(CODE)
    told.session(other)
    told.push(rig)
    before, kept = http.get(f"/v1/participants/{other}/sessions").json(), files(centre)
    assert main.run(asked(centre)) == 0
    assert http.get(f"/v1/participants/{other}/sessions").json() == before
    assert len(files(centre)) == len(kept) - 2
    bodies = [item.body or "" for item in centre.context.store.all(CentreItem)]
    assert any(f'"participant":"{other}"' in body for body in bodies) and CODE not in "".join(bodies)


def test_cut_off_it_goes_on(
    centre: Centre, rig: httpx.Client, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = Teller()
    told.session(CODE)
    told.push(rig)

    def fails(_self: Bucket, _sha256: str) -> None:
        raise BucketError("the disk is full of sand")

    with monkeypatch.context() as patch:
        patch.setattr(buckets.Bucket, "remove", fails)
        assert main.run(asked(centre)) == 1 and "once more" in capsys.readouterr().err
    assert len(files(centre)) == 2
    assert main.run(asked(centre)) == 0 and files(centre) == set()
    (done,) = centre.app.state.context.store.all(Erasure)
    assert (done.of, done.files) == ("(erased)", []) and done.done_utc


def test_a_folder_that_is_none_is_not_taken_for_a_centre_without_the_participant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "wrong"
    assert main.run(["centre", "erase", CODE, "--reason", "asked", "--data", str(wrong)]) == 2
    assert "there is no database" in capsys.readouterr().err and not wrong.exists()


def test_a_reason_names_nobody(tmp_path: Path, centre: Centre, capsys: pytest.CaptureFixture[str]) -> None:
    for reason in ("", f"{CODE} asked"):
        assert main.run(["centre", "erase", CODE, "--reason", reason, "--data", str(centre.data)]) == 2
        assert "--reason" in capsys.readouterr().err
