"""The structure of the last approved model after a test: beside the plain one, offered, told, never in the way."""

from __future__ import annotations

import asyncio
import html
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from stimrig.api.cli import main
from stimrig.api.cli.reports import carried_lines
from stimrig.api.models import carried_structure
from stimrig.api.settings import Settings
from stimrig.api.store.tables import Approval, Model
from tests.api.clinic import Clinic
from tests.api.conftest import STUB, Service, play_test, run_test, serving, signed_in, soon, wait_done
from tests.api.test_one_service import command

CSV = "time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n"


# ---- on the database alone ------------------------------------------------------------------------------------------


@pytest.fixture
def clinic(tmp_path: Path) -> Iterator[Clinic]:
    made = Clinic(tmp_path)
    yield made
    made.store.close()


def carry(clinic: Clinic) -> tuple[Model, Model]:
    """The plain model of a new test, and the one that is offered."""
    plain, data = clinic.model(), str(clinic.folder / "data.h5")
    analyses: Any = clinic
    offered = asyncio.run(carried_structure.carry(analyses, plain, data))
    return clinic.versions.get(plain.id), offered


@pytest.mark.parametrize("expired", [False, True])
def test_structure_of_the_approved_model_is_a_child_of_the_plain_one_and_offered(clinic: Clinic, expired: bool) -> None:
    """Also of an approval whose day is over."""
    earlier = clinic.model(("fatigue", "threshold_drift"))
    clinic.approve(earlier.id)
    if expired:
        with clinic.store.write() as session:
            session.query(Approval).update({"expires_utc": "2020-01-01T00:00:00Z"})
        assert clinic.versions.approved("P017") is None
    plain, child = carry(clinic)
    assert (plain.effects, plain.parent_id, plain.carried_from_id) == ([], None, None)
    assert (child.effects, child.parent_id, child.carried_from_id) == (["fatigue"], plain.id, earlier.id)
    assert f'"parent": "{plain.id}"' in child.document.decode()
    for row in (plain, child):
        assert row.carried is not None
        assert (row.carried["from_model_id"], row.carried["offered"]) == (earlier.id, "carried")
        assert row.carried["still_needed"] == ["fatigue"] and row.carried["no_longer_needed"] == ["threshold_drift"]
    lines = "\n".join(carried_lines(child.carried))
    assert earlier.id in lines and "no longer needed: threshold_drift" in lines, "on the terminal, too"


def reject(clinic: Clinic, model_id: str) -> None:
    clinic.approve(model_id)
    clinic.versions.decide(model_id, False, "Ada", "electrode slipped")


def damage(clinic: Clinic, model_id: str) -> None:
    """A damaged row of the database must not cost a test its model."""
    clinic.approve(model_id)
    with clinic.store.write() as session:
        session.get_one(Model, model_id).document = b"\xff\xfe"


def uninstall(clinic: Clinic, model_id: str) -> None:
    clinic.approve(model_id)
    (clinic.folder / "does-not-carry").write_text("The earlier model holds my_effect, which is not installed here.")


@pytest.mark.parametrize(
    ("effects", "decide", "why", "words"),
    [
        (("fatigue",), lambda *_: None, None, ""),
        (("fatigue",), reject, None, ""),
        (("threshold_drift",), Clinic.approve, "nothing-needed", "A reason of the stub."),
        ((), Clinic.approve, "plain-before", "A reason of the stub."),
        (("fatigue",), damage, "model-damaged", "The structure of the last session was not fitted."),
        (("fatigue",), uninstall, "data", "my_effect, which is not installed here."),
    ],
)
def test_the_plain_model_is_offered_where_nothing_is_carried(
    clinic: Clinic, effects: tuple[str, ...], decide: Callable[[Clinic, str], None], why: str | None, words: str
) -> None:
    earlier = clinic.model(effects)
    decide(clinic, earlier.id)
    plain, offered = carry(clinic)
    assert offered.id == plain.id and clinic.store.all(Model, Model.parent_id == plain.id) == []
    assert plain.carried_from_id == (earlier.id if why == "plain-before" else None)
    found = plain.carried or {"why": None, "offered": "plain", "reason": ""}
    assert (found["why"], found["offered"]) == (why, "plain") and words in found["reason"]


# ---- through the service --------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("how", ["cancelled", "died"])
def test_plain_model_is_there_and_offered_whatever_becomes_of_the_carried_one(
    how: str, client: httpx.Client, service: Service, pages: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    (service.context.settings.recordings_dir / "carrying-slowly").touch()
    started = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    while_carrying = until_carrying(client, started)
    assert while_carrying["identification"]["text"] == "fitting last session's structure"
    form = re.search(r'<form[^>]*id="keep-plain"[^>]*>', pages.get(f"/tests/{started}").text)
    assert form and "hidden" not in form[0]
    plain = client.get(while_carrying["model_url"]).json()
    assert plain["effects"] == [] and while_carrying["state"] == "identifying"
    if how == "cancelled":
        assert client.post(f"/v1/tests/{started}/keep-plain").status_code == 200
    else:
        for worker in service.context.pool.workers:
            if worker.job is not None and worker.job.kind == "carry":
                worker.end()
    test = wait_done(client, started)
    (only,) = versions(client, participant, test)
    assert test["state"] == "completed" and test["model_id"] == only["id"] == plain["id"]
    words = {"cancelled": "The job was cancelled.", "died": "The worker process died."}[how]
    assert words in only["carried"]["reason"] and only["carried"]["offered"] == "plain"
    assert client.post(f"/v1/tests/{started}/keep-plain").status_code == 409
    assert 'id="keep-plain"' not in pages.get(f"/tests/{started}").text


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


# ---- The structure that a site's new participants start with: taken by the fit after a test, kept, shown, refused


def test_settings_name_effects_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().structure == ()
    monkeypatch.setenv("STIMRIG_STRUCTURE", " fatigue,threshold_drift ,fatigue,")
    assert Settings().structure == ("fatigue", "threshold_drift")


@pytest.mark.parametrize(
    ("structure", "approved", "effects", "words"),
    [(("fatigue",), False, ["fatigue"], ""), (("fatigue",), True, [], ""), (("bad",), False, [], "not with bad: ")],
)
def test_the_first_model_has_the_sites_structure_until_one_is_approved(
    clinic: Clinic, structure: tuple[str, ...], approved: bool, effects: list[str], words: str
) -> None:
    """A person went through the test: a structure that the recording does not bear costs it no model."""
    if approved:
        clinic.approve(clinic.model().id)
    analyses: Any = SimpleNamespace(versions=clinic.versions, run=clinic.run, settings=Settings(structure=structure))
    found, warning = asyncio.run(carried_structure.fit(analyses, "P017", str(clinic.folder / "data.h5")))
    assert [effect["id"] for effect in found["model"]["effects"]] == effects
    assert words in warning and bool(warning) == bool(words)


def test_what_was_left_out_of_a_sites_structure_is_said_everywhere(tmp_path: Path, short_dir: Path) -> None:
    """The page, the REST answer and the report say the same, also when they are loaded again."""
    with serving(tmp_path / "site", short_dir, STUB, structure="fatigue, tremor") as (site, client):
        first = play_test(client, "P1")["fit"]
        assert (first["effects"], first["parent_id"]) == (["fatigue", "tremor"], None)
        own = client.get(f"/v1/models/{first['id']}/diagnosis").json()
        assert own["structure"] == ["fatigue", "tremor"]
        assert "fatigue" not in [entry["effect"] for entry in own["missing"]]
        rows = client.post(f"/v1/models/{first['id']}/improve").json()["versions"]
        assert [row["parent_id"] for row in rows] == [None, first["id"]]
        site.context.settings.structure = ("bad",)
        client.post("/v1/participants", json={"code": "P2"})
        test, taken = play_test(client, "P3"), client.post("/v1/participants/P2/recordings", content=CSV).json()
        (told,) = taken["warnings"]
        assert test["state"] == "completed" and test["summary"]["warnings"][-1] == told
        with signed_in(site) as browser:
            for model_id in (test["model_id"], taken["model"]["id"]):
                for path in (f"/models/{model_id}", f"/models/{model_id}/report"):
                    assert html.escape(told) in browser.get(path).text
            exports = browser.get(f"/models/{taken['model']['id']}").text.partition('aria-label="Export"')[2]
            assert ">CSV<" in exports and ">HDF5<" not in exports.partition("</div>")[0], "it came as a table"


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
