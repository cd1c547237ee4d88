"""The structure of the last approved model after a test: beside the plain one, offered, told, never in the way."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.models import carried_structure
from stimrig.api.store.tables import Approval, Model
from tests.api.clinic import Clinic
from tests.api.conftest import Service, run_test, soon, wait_done

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


def test_plain_model_is_there_and_offered_where_the_carried_fit_dies(
    client: httpx.Client, service: Service, pages: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    (service.context.settings.recordings_dir / "carrying-slowly").touch()
    started = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    while_carrying = until_carrying(client, started)
    assert while_carrying["identification"]["text"] == "fitting last session's structure"
    assert f'<a href="{while_carrying["model_url"].removeprefix("/v1")}">Open' in pages.get(f"/tests/{started}").text
    plain = client.get(while_carrying["model_url"]).json()
    assert plain["effects"] == [] and while_carrying["state"] == "identifying"
    for worker in service.context.pool.workers:
        if worker.job is not None and worker.job.kind == "carry":
            worker.end()
    test = wait_done(client, started)
    (only,) = versions(client, participant, test)
    assert test["state"] == "completed" and test["model_id"] == only["id"] == plain["id"]
    assert "The worker process died." in only["carried"]["reason"] and only["carried"]["offered"] == "plain"


def until_carrying(client: httpx.Client, test_id: str) -> dict[str, Any]:
    """The test while the structure of the last session is fitted."""

    def carrying() -> dict[str, Any] | None:
        test = client.get(f"/v1/tests/{test_id}").json()
        work = test["identification"] or {}
        begun = work.get("verb") == "carry" and work["progress"] > 0
        return test if begun and test["model_url"] else None  # the row is read before the job that names a verb

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


def test_upload_takes_the_structure_over_too(
    client: httpx.Client, pages: httpx.Client, participant: str, approved: dict[str, Any]
) -> None:
    taken = client.post(f"/v1/participants/{participant}/recordings", content=CSV).json()
    model = taken["model"]
    assert model["effects"] == ["fatigue"] and model["carried_from_id"] == approved["id"]
    plain, child = versions(client, participant, taken)
    assert child["id"] == model["id"] and child["parent_id"] == plain["id"]
    page = pages.get(f"/models/{model['id']}").text
    carried = page.partition('id="carried"')[2].partition("</details>")[0]
    assert "A reason of the stub." in carried and approved["id"] in carried and "no longer needed" in carried
    exports = page.partition('aria-label="Export"')[2].partition("</nav>")[0]
    assert ">CSV<" in exports and ">HDF5<" not in exports, "it came as a table"
