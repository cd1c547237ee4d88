"""The structure of the last approved model after a test: beside the plain one, offered, told, never in the way."""

from __future__ import annotations

import asyncio
import html
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import httpx
import pytest

from stimrig.api.cli import main
from stimrig.api.cli.terminal import carried_lines
from stimrig.api.models import carried_structure
from stimrig.api.settings import Settings
from stimrig.api.store.tables import Approval
from tests.api.conftest import STUB, Service, csrf, play_test, run_service, run_test, signed_in, soon, wait_done
from tests.api.test_one_service import command

CSV = "time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n"


@pytest.fixture
def approved(client: httpx.Client, participant: str) -> dict[str, Any]:
    """A version with fatigue and threshold drift that a person approved."""
    first = run_test(client, participant)["model_id"]
    body = {"effects": ["fatigue", "threshold_drift"], "force": True, "reason": "seen last week"}
    row = client.post(f"/v1/models/{first}/effects", json=body).json()
    client.post(f"/v1/models/{row['id']}/approve")
    return row


def versions(client: httpx.Client, participant: str, test: dict[str, Any]) -> list[dict[str, Any]]:
    """The versions of a test's recording, oldest first."""
    rows = client.get(f"/v1/participants/{participant}/models").json()
    return [row for row in reversed(rows) if row["recording_id"] == test["recording_id"]]


def test_structure_of_the_approved_model_is_a_child_of_the_plain_one_and_offered(
    client: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    test = run_test(client, participant)
    plain, child = versions(client, participant, test)
    assert (plain["effects"], plain["parent_id"], plain["carried_from_id"]) == ([], None, None)
    assert child["effects"] == ["fatigue"] and child["parent_id"] == plain["id"]
    assert child["carried_from_id"] == approved["id"] and test["model_id"] == child["id"]
    for row in (plain, child, test["fit"]):
        assert row["carried"]["from_model_id"] == approved["id"] and row["carried"]["offered"] == "carried"
        assert row["carried"]["still_needed"] == ["fatigue"]
        assert row["carried"]["no_longer_needed"] == ["threshold_drift"]
    document = client.get(f"/v1/models/{child['id']}/file").json()
    assert document["extra"]["parent"] == plain["id"]
    lines = "\n".join(carried_lines(test["fit"]["carried"]))
    assert approved["id"] in lines and "no longer needed: threshold_drift" in lines, "on the terminal, too"


def test_nothing_is_carried_without_an_approval_or_from_a_rejected_model(
    client: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    client.post(f"/v1/models/{approved['id']}/reject", json={"reason": "electrode slipped"})
    test = run_test(client, participant)
    (only,) = versions(client, participant, test)
    assert (only["effects"], only["carried"], only["carried_from_id"]) == ([], None, None)


def test_approval_whose_day_is_over_still_lends_its_structure(
    client: httpx.Client, service: Service, participant: str, approved: dict[str, Any]
) -> None:
    store = service.context.store
    with store.write() as session:
        for row in session.query(Approval):
            row.expires_utc = "2020-01-01T00:00:00Z"
    assert client.get(f"/v1/participants/{participant}/model").status_code == 404
    assert run_test(client, participant)["fit"]["carried_from_id"] == approved["id"]


def test_plain_is_offered_where_nothing_is_needed_any_more(client: httpx.Client, participant: str) -> None:
    first = run_test(client, participant)["model_id"]
    body = {"effects": ["threshold_drift"], "force": True, "reason": "seen last week"}
    row = client.post(f"/v1/models/{first}/effects", json=body).json()
    client.post(f"/v1/models/{row['id']}/approve")
    test = run_test(client, participant)
    (plain,) = versions(client, participant, test)
    assert test["model_id"] == plain["id"] and plain["effects"] == []
    assert plain["carried"]["no_longer_needed"] == ["threshold_drift"] and plain["carried"]["why"] == "nothing-needed"
    again = client.post(f"/v1/models/{plain['id']}/effects", json={"effects": ["fatigue"]})
    assert again.status_code == 201 and again.json()["carried"] is None


def test_plain_structure_carries_over_as_one_version(client: httpx.Client, participant: str) -> None:
    first = run_test(client, participant)["model_id"]
    client.post(f"/v1/models/{first}/approve")
    test = run_test(client, participant)
    (only,) = versions(client, participant, test)
    assert only["carried_from_id"] == first and only["carried"]["why"] == "plain-before"


@pytest.mark.parametrize("how", ["refused", "cancelled", "died"])
def test_plain_model_is_there_and_offered_whatever_becomes_of_the_carried_one(
    how: str, client: httpx.Client, service: Service, participant: str, approved: dict[str, Any]
) -> None:
    folder = service.context.settings.recordings_dir
    told = "The earlier model holds my_effect, which is not installed here."
    (folder / ("does-not-carry" if how == "refused" else "carrying-slowly")).write_text(told)
    started = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    if how != "refused":
        while_carrying = until_carrying(client, started)
        assert while_carrying["identification"]["text"] == "fitting last session's structure"
        plain = client.get(while_carrying["model_url"]).json()
        assert plain["effects"] == [] and while_carrying["state"] == "identifying"
    if how == "cancelled":
        assert client.post(f"/v1/tests/{started}/keep-plain").status_code == 200
    if how == "died":
        for worker in service.context.pool.workers:
            if worker.job is not None and worker.job.kind == "carry":
                worker.end()
    test = wait_done(client, started)
    (only,) = versions(client, participant, test)
    assert test["state"] == "completed" and test["model_id"] == only["id"] and only["effects"] == []
    words = {"refused": told, "cancelled": "The job was cancelled.", "died": "The worker process died."}[how]
    assert words in only["carried"]["reason"] and only["carried"]["offered"] == "plain"
    assert client.post(f"/v1/tests/{started}/keep-plain").status_code == 409


def until_carrying(client: httpx.Client, test_id: str) -> dict[str, Any]:
    """The test while the structure of the last session is fitted."""

    def carrying() -> dict[str, Any] | None:
        test = client.get(f"/v1/tests/{test_id}").json()
        work = test["identification"] or {}
        return test if work.get("verb") == "carry" and work["progress"] > 0 else None

    return soon(carrying)


def test_restart_goes_on_after_the_plain_version(
    client: httpx.Client, service: Service, participant: str, approved: dict[str, Any]
) -> None:
    """What the restarted service finds: an open test that names its first version."""
    test = run_test(client, participant)
    plain, _ = versions(client, participant, test)
    context = service.context
    context.runner.lifecycle.update(test["id"], state="identifying", model_id=plain["id"])
    service.run(context.runner.resume())
    test = wait_done(client, test["id"])
    rows = versions(client, participant, test)
    assert [row["effects"] for row in rows].count([]) == 1 and test["fit"]["effects"] == ["fatigue"]


def test_upload_takes_the_structure_over_too(client: httpx.Client, participant: str, approved: dict[str, Any]) -> None:
    taken = client.post(f"/v1/participants/{participant}/recordings", content=CSV).json()
    assert taken["model"]["effects"] == ["fatigue"] and taken["model"]["carried_from_id"] == approved["id"]
    plain, child = versions(client, participant, taken)
    assert child["id"] == taken["model"]["id"] and child["parent_id"] == plain["id"]


def test_model_page_says_what_carries_over(
    client: httpx.Client, pages: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    test = run_test(client, participant)
    plain, child = versions(client, participant, test)
    client.get(f"/v1/models/{child['id']}/diagnosis")
    page = pages.get(f"/models/{child['id']}").text
    section = page[page.index('id="carried"') :].partition("</section>")[0]
    assert "has the structure of the last approved model" in section
    assert "<b>Fatigue</b>" in section and ">kept<" in section
    assert "<b>Threshold_drift</b>" in section and "asked for again" in section  # by the stub's diagnosis
    assert f"/models/{plain['id']}" in section
    other = pages.get(f"/models/{plain['id']}").text
    assert "is better" in other and f"/models/{child['id']}" in other
    assert 'id="carried"' not in pages.get(f"/models/{approved['id']}").text


METHOD = "maximum-likelihood"


@pytest.mark.parametrize("document", [b"\xff\xfe", b'{"sample_rate_hz": 41.0}'], ids=["no text", "another digit"])
def test_a_damaged_approved_model_leaves_the_plain_one(document: bytes) -> None:
    """A damaged row of the database must not cost a test its model."""
    plain = SimpleNamespace(id="M2", participant="P1", recording_id="R2", effects=[], method=METHOD)
    earlier = SimpleNamespace(id="M1", recording_id="R1", document=document, etag="", method=METHOD)
    kept: list[dict[str, Any]] = []
    versions: Any = SimpleNamespace(
        last_approved=lambda _: earlier,
        get=lambda _: plain,
        note_carried=lambda _id, finding, _from: kept.append(finding),
    )
    analyses: Any = SimpleNamespace(versions=versions, run=None)
    offered = asyncio.run(carried_structure.carry(analyses, cast("Any", plain), "data.h5"))
    assert (offered, kept[0]["offered"], kept[0]["why"]) == (plain, "plain", "model-damaged")


def test_the_page_offers_to_keep_the_plain_model_while_the_other_is_fitted(
    client: httpx.Client, service: Service, pages: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    (service.context.settings.recordings_dir / "carrying-slowly").touch()
    started = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    plain = until_carrying(client, started)["model_id"]
    form = re.search(r'<form[^>]*id="keep-plain"[^>]*>', pages.get(f"/tests/{started}").text)
    assert form and "hidden" not in form[0]
    kept = pages.post(f"/tests/{started}/keep-plain", data={"csrf": csrf(pages)})
    assert (kept.status_code, kept.headers["location"]) == (303, f"/models/{plain}")
    assert wait_done(client, started)["model_id"] == plain
    late = pages.post(f"/tests/{started}/keep-plain", data={"csrf": csrf(pages)})
    assert (late.status_code, late.headers["location"]) == (303, f"/tests/{started}")
    assert 'id="keep-plain"' not in pages.get(f"/tests/{started}").text


# ---- The structure that a site's new participants start with: taken by the fit after a test, kept, shown, refused


@pytest.fixture
def site(tmp_path: Path, short_dir: Path) -> Iterator[Service]:
    yield from run_service(tmp_path / "site", short_dir, STUB, structure="fatigue, tremor")


@pytest.mark.slow
def test_settings_name_effects_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().structure == ()
    monkeypatch.setenv("STIMRIG_STRUCTURE", " fatigue,threshold_drift ,fatigue,")
    assert Settings().structure == ("fatigue", "threshold_drift")


@pytest.mark.slow
def test_models_have_the_sites_structure_until_one_is_approved(site: Service) -> None:
    settings = site.context.settings
    with site.client() as client:
        client.post("/v1/participants", json={"code": "P1"})
        first = client.get(f"/v1/models/{run_test(client, 'P1')['model_id']}").json()
        assert (first["effects"], first["parent_id"]) == (["fatigue", "tremor"], None)
        own = client.get(f"/v1/models/{first['id']}/diagnosis").json()
        assert own["structure"] == ["fatigue", "tremor"]
        assert "fatigue" not in [entry["effect"] for entry in own["missing"]]
        rows = client.post(f"/v1/models/{first['id']}/improve").json()["versions"]
        assert [row["parent_id"] for row in rows] == [None, first["id"]]
        client.post(f"/v1/models/{first['id']}/approve")
        settings.structure = ("threshold_drift",)
        assert client.get(f"/v1/models/{run_test(client, 'P1')['model_id']}").json()["effects"] == ["fatigue", "tremor"]
        client.post("/v1/participants", json={"code": "P2"})
        assert run_test(client, "P2")["fit"]["effects"] == ["threshold_drift"]
        settings.structure = ("fatigue",)
        assert run_test(client, "P2")["fit"]["effects"] == ["fatigue"]
        client.post("/v1/participants", json={"code": "P3"})
        csv = "time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n"
        taken = client.post("/v1/participants/P3/recordings", content=csv).json()
        assert (taken["model"]["effects"], taken["warnings"]) == (["fatigue"], [])


@pytest.mark.slow
def test_structure_that_the_recording_does_not_bear_is_left_out_and_said(site: Service) -> None:
    """A person went through the test: it gives a model all the same."""
    site.context.settings.structure = ("bad",)
    with site.client() as client:
        test = play_test(client, "P1")
        assert test["state"] == "completed"
        assert client.get(f"/v1/models/{test['model_id']}").json()["effects"] == []
        assert "not with bad: effects: no effect bad" in test["summary"]["warnings"][-1]
        with signed_in(site) as browser:
            assert csrf(browser) and "not with bad" in browser.get(f"/models/{test['model_id']}").text


@pytest.mark.slow
def test_an_uploads_model_page_says_what_was_left_out_of_its_structure(site: Service) -> None:
    """The page, the REST answer and the report say the same, also when they are loaded again."""
    site.context.settings.structure = ("bad",)
    csv = "time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n"
    with site.client() as client, signed_in(site) as browser:
        for code in ("P1", "P2"):
            client.post("/v1/participants", json={"code": code})
        (told,) = client.post("/v1/participants/P1/recordings", content=csv).json()["warnings"]
        form, token = "/participants/P2/recordings", csrf(browser)
        page = browser.post(
            form, data={"csrf": token}, files={"file": ("a.csv", f"{csv}0.025,0,0,rest\n")}, follow_redirects=True
        )
        assert page.url.path.startswith("/models/") and html.escape(told) in page.text
        assert html.escape(told) in browser.get(page.url.path).text
        exports = page.text.partition('aria-label="Export"')[2].partition("</div>")[0]
        assert ">CSV<" in exports and ">HDF5<" not in exports, "it came as a table"
        assert html.escape(told) in browser.get(f"{page.url.path}/report").text


@pytest.mark.slow
def test_unknown_effect_is_one_line_before_the_service_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = command(tmp_path, STRUCTURE="fatigue,phlogiston")
    done = subprocess.run(**given, capture_output=True, timeout=120)
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert done.returncode == 2 and done.stdout == ""
    assert line.startswith("stimrig: STIMRIG_STRUCTURE: no effect is called phlogiston. Take some of ")
    monkeypatch.setenv("STIMRIG_STRUCTURE", "Fatigue!")
    assert main.run(["serve", "--data", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "STIMRIG_STRUCTURE: Fatigue! is no effect's id" in err
