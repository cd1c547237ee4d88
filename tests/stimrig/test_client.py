"""`stimrig.Client` against a served app: the whole path of a session, live signals, jobs, and its errors."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from stimrig import Client, errors
from stimrig.api.client.documents import Job, Participant, SessionTest, Version
from stimrig.api.web.responses.models import JobOut, VersionOut
from stimrig.api.web.responses.people import ParticipantOut
from stimrig.api.web.responses.rig import TestOut
from tests.api.conftest import PATIENCE_S, TOKEN, Service


@pytest.fixture
def client(service: Service) -> Any:
    with Client(service.url, TOKEN, PATIENCE_S) as client:
        client.make_participant("P017")
        yield client


def test_a_session_from_participant_to_controller(client: Client, service: Service) -> None:
    seen: list[float] = []
    test = client.run_test("P017", lambda now: seen.append(now["progress"]))
    assert test["state"] == "completed" and seen == sorted(seen)
    with pytest.raises(errors.NotFound, match="No approved model") as caught:
        client.approved_model("P017")
    assert caught.value.status == 404 and caught.value.code == "no-approved-model"
    assert client.approve(test["model_id"], "good fit")["served"]
    with Client(service.url, client.issue_token("controller", ["read-model"])) as controller:
        first = controller.approved_model("P017")
        again = controller.approved_model("P017", first)
        assert first.changed and first.document["model_id"] == test["model_id"]
        assert not again.changed and again.document == first.document
        with pytest.raises(errors.Forbidden):
            controller.start_test("P017")
    assert client.recording(test["recording_id"]).startswith(b"\x89HDF")
    assert client.reject(test["model_id"])["decision"] == "rejected"
    assert [row["id"] for row in client.versions("P017")] == [client.version(test["model_id"])["id"]]


def test_adding_an_effect_as_a_job_and_at_once(client: Client) -> None:
    model_id = client.run_test("P017")["model_id"]
    told: list[tuple[float, str]] = []
    child = client.add_effects(model_id, ["fatigue"], progress=lambda *now: told.append(now))
    assert child["parent_id"] == model_id and child["effects"] == ["fatigue"]
    assert told[-1] == (1.0, "done")
    with pytest.raises(errors.Conflict, match=r"in the model"):
        client.add_effects(child["id"], ["fatigue"])
    with pytest.raises(errors.Conflict, match=r"in the model"):
        client.add_effects(child["id"], ["fatigue"], progress=lambda *_: None)
    assert client.improve(model_id)["parent_id"]


def test_what_progress_raises_cancels_the_job(client: Client) -> None:
    model_id = client.run_test("P017")["model_id"]
    client.diagnosis(model_id)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client.improve(model_id, interrupted)
    assert client.job("J1")["done"], "nothing goes on behind the person's back"


def test_live_signals_come_until_the_end(client: Client, service: Service) -> None:
    service.rig.speed = 5.0
    messages = list(client.live(client.start_test("P017")["id"]))
    assert {"history", "live", "test"} <= {message["type"] for message in messages}
    assert messages[-1]["test"]["state"] == "completed"
    with Client(service.url) as stranger, pytest.raises(errors.Unauthorized):
        next(stranger.live("T1"))


def test_stop_is_confirmed_and_the_test_says_so(client: Client, service: Service) -> None:
    service.rig.speed = 1.0
    test_id = client.start_test("P017")["id"]
    assert client.stop("enough")["stopped"]
    *_, last = client.follow(test_id)
    assert last["state"] == "stopped"


@pytest.mark.parametrize(
    ("ask", "error", "status"),
    [
        (lambda client: client.version("M0"), errors.NotFound, 404),
        (lambda client: client.make_participant("P017"), errors.Conflict, 409),
        (lambda client: client.preview("P017", segments=[{"name": "x", "sequence": "polka"}]), errors.Invalid, 422),
        (lambda client: client.upload("P017", b""), errors.Invalid, 422),
    ],
    ids=["not there", "taken", "unusable plan", "empty file"],
)
def test_errors_carry_the_problem(client: Client, ask: Any, error: type[errors.Refused], status: int) -> None:
    with pytest.raises(error) as caught:
        ask(client)
    found = caught.value
    assert found.status == status and found.title and found.detail
    assert str(found) == f"{found.request}: {found.title}: {found.detail}"
    assert isinstance(found, errors.ServiceError) and found.document["status"] == status


def test_a_wrong_token_is_unauthorized(service: Service) -> None:
    with Client(service.url, "guessed") as stranger, pytest.raises(errors.Unauthorized):
        stranger.participants()


@pytest.mark.parametrize("address", ["http://127.0.0.1:{port}", "no address", "http://[::1"])
def test_without_an_answer_the_error_names_the_address(address: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, and never listening
        url = address.format(port=taken.getsockname()[1])
        with pytest.raises(errors.Unreachable) as caught, Client(url) as client:
            client.health()
    assert url in str(caught.value) and caught.value.status is None


def test_documents_have_the_keys_of_the_openapi_document() -> None:
    pairs = {Version: VersionOut, Job: JobOut, SessionTest: TestOut, Participant: ParticipantOut}
    for document, model in pairs.items():
        assert set(document.__annotations__) == set(model.model_fields)


def test_who_ran_a_test_and_what_is_not_under_way(client: Client) -> None:
    test = client.run_test("P017")
    assert client.set_ran_by(test["id"], "Jörg Müller")["ran_by"] == "Jörg Müller"
    assert client.set_ran_by(test["id"], None)["ran_by"] == "administrator"
    with pytest.raises(errors.Conflict, match="No structure is being carried over"):
        client.keep_plain(test["id"])
    with pytest.raises(errors.Conflict, match="nothing to lock"):
        client.lock()
