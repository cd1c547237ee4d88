"""A controller's trials: each moves what is served within what a person allowed, and nothing beyond that."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.errors import ApiError
from stimrig.api.models import tracking
from stimrig.api.models.tracking import NEW_TEST, Limits
from stimrig.api.store.tables import Model, Test, Tracked
from stimrig.rig.messages import FinishedEvent
from tests.api.conftest import STUB, Service, run_test, serving, soon, wait_done

WIDTHS = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [100.0] * 40}}]
MODEL, TRACKING = "/v1/participants/P017/model", "/v1/participants/P017/tracking"


def play(client: httpx.Client, **more: Any) -> dict[str, Any]:
    body = {"participant": "P017", "kind": "sequence", "segments": WIDTHS, **more}
    started = client.post("/v1/tests", json=body)
    assert started.status_code == 202, started.text
    test = wait_done(client, started.json()["id"])
    tracked(client)  # waits until it has been followed, and what is said next is said of the next one
    return test


def tracked(client: httpx.Client, **headers: str) -> httpx.Response:
    return client.get(MODEL, params={"tracked": True}, headers=headers)


def trials(client: httpx.Client) -> list[dict[str, Any]]:
    return client.get(TRACKING).json()["trials"]


def say(service: Service, **wanted: Any) -> None:
    """What the worker says of the next trial."""
    (service.data / "recordings" / "track.json").write_text(json.dumps(wanted))


def gain(document: dict[str, Any], approved: dict[str, Any]) -> float:
    return document["recruitment"]["torque_nm"][-1] / approved["recruitment"]["torque_nm"][-1]


# ---- what is served ---------------------------------------------------------------------------------------------


def test_each_trial_moves_it_and_the_approved_one_never_changes(client: httpx.Client, approved: str) -> None:
    before, followed = client.get(MODEL), tracked(client)
    assert followed.content == before.content and followed.headers["etag"] == before.headers["etag"], "no trial yet"
    assert "last-modified" in followed.headers and "last-modified" not in before.headers
    assert trials(client) == [] and client.get(TRACKING).json()["served_trial"] == 0
    tags = {before.headers["etag"]}
    for number in (1, 2, 3):
        test = play(client)
        answer = tracked(client)  # at once: a trial that has just ended is waited for
        document = answer.json()
        told = document["tracking"]
        assert gain(document, before.json()) == pytest.approx(0.98**number)
        assert (told["trial"], told["test_id"], told["approved_model_id"]) == (number, test["id"], approved)
        assert told["ask"] is None and told["outcome"] == "followed" and told["limits"]["gain_percent"] == 20.0
        assert told["coming"]["gain"]["low"] < told["coming"]["gain"]["value"]
        assert document["model_id"].startswith(f"{approved}.") and document["model_id"].endswith(f".{number}")
        assert tracked(client, **{"If-None-Match": answer.headers["etag"]}).status_code == 304
        tags.add(answer.headers["etag"])
    assert len(tags) == 4
    after = client.get(MODEL)
    assert after.content == before.content and dict(after.headers) | {"date": ""} == dict(before.headers) | {"date": ""}
    assert [row["number"] for row in trials(client)] == [1, 2, 3]
    entries = [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "track model"]
    assert len(entries) == 3 and all(entry["subject"] == approved for entry in entries)
    assert client.get("/v1/audit").json()["whole"]


def test_without_an_approval_nothing_is_served_or_noted(client: httpx.Client, participant: str) -> None:
    run_test(client, participant)
    play(client)
    assert tracked(client).status_code == client.get(TRACKING).status_code == 404
    assert client.get("/v1/participants/P999/tracking").json()["title"] == "No such participant"


def test_a_tracked_version_foretells_a_trial(client: httpx.Client, approved: str) -> None:
    play(client)
    tracked_id, body = tracked(client).json()["model_id"], {"pulse_width_us": [100.0]}
    for model_id in (approved, tracked_id, f"{approved}.1.0"):
        told = client.post(f"/v1/models/{model_id}/prediction", json=body)
        assert told.status_code == 200 and told.json()["model_id"] == model_id
        wanted = client.post(f"/v1/models/{model_id}/widths", json={"reference_torque_nm": [0.0, 1.0]})
        assert wanted.status_code == 200 and wanted.json()["model_id"] == model_id
    unknown = (f"{approved}.99.0", f"{approved}.0.0", "none.1.0")  # no such approval of that model
    for model_id in (f"{approved}.1.2", f"{approved}.2.1", "none.1.1", f"{approved}.1.{'9' * 30}", ".1.1", *unknown):
        assert client.post(f"/v1/models/{model_id}/prediction", json=body).status_code == 404
        wanted = {"reference_torque_nm": [1.0]}
        assert client.post(f"/v1/models/{model_id}/widths", json=wanted).status_code == 404


# ---- within what a person allowed -------------------------------------------------------------------------------


def test_beyond_a_limit_the_last_version_within_stays_and_asks(service: Service, client: httpx.Client, approved: str):
    """Which words for which limit: below."""
    client.post(f"/v1/models/{approved}/approve", json={"tracking": {"time_scale_percent": 5.0}})
    play(client)
    good, words = tracked(client), "the time scale is expected to be 106.0 %"
    say(service, values={"time_scale": 1.06})
    play(client)
    asked = tracked(client)
    document, told = asked.json(), asked.json()["tracking"]
    assert asked.headers["etag"] != good.headers["etag"] and words in told["ask"] and NEW_TEST in told["ask"]
    assert {**document, "tracking": None} == {**good.json(), "tracking": None}
    assert {**told, "ask": None} == good.json()["tracking"], "trial, levels and age are those of what is served"
    assert asked.headers["last-modified"] == good.headers["last-modified"]
    row = trials(client)[-1]
    assert row["outcome"] == "followed" and words in row["ask"] and client.get(TRACKING).json()["ask"] == row["ask"]


def test_beyond_it_at_the_first_trial_the_approved_model_asks(service: Service, client: httpx.Client, approved: str):
    say(service, values={"gain": 1.5})
    play(client)
    document = tracked(client).json()
    plain = client.get(MODEL).json()
    assert document["tracking"]["ask"] and document["tracking"]["trial"] == 0
    assert document["recruitment"] == plain["recruitment"] and "tracking" not in plain


def test_a_trial_that_contradicts_the_structure_asks_and_the_next_good_one_goes_on(
    service: Service, client: httpx.Client, approved: str
) -> None:
    play(client)
    say(service, outcome="contradicts", error_nm=0.4)
    play(client)
    document = tracked(client).json()
    assert "Trial 2 contradicts the structure" in document["tracking"]["ask"] and document["tracking"]["trial"] == 1
    play(client)
    document = tracked(client).json()
    assert document["tracking"]["ask"] is None and document["tracking"]["trial"] == 3


def test_two_trials_running_that_cannot_be_followed_ask(service: Service, client: httpx.Client, approved: str) -> None:
    play(client)
    good = tracked(client)
    for number in (2, 3):
        say(service, reason="the record is too short")
        play(client)
        assert bool(tracked(client).json()["tracking"]["ask"]) is (number == 3)
    document, before = tracked(client).json(), good.json()
    assert document["tracking"]["ask"].startswith("Trials 2 and 3 could not be followed")
    assert document["recruitment"] == before["recruitment"] and document["tracking"]["trial"] == 1
    assert client.get(TRACKING).json()["ask"] == document["tracking"]["ask"]
    play(client)
    assert tracked(client).json()["tracking"]["ask"] is None, "the next one is followed again"


def test_limits_that_are_none_are_refused_and_nothing_is_approved(client: httpx.Client, participant: str) -> None:
    model, head = run_test(client, participant)["model_id"], {"Content-Type": "application/json"}
    for percent in ("-1", "60.5", '"20"', "null", "true", "1e400"):
        body = f'{{"tracking": {{"gain_percent": {percent}}}}}'
        refused = client.post(f"/v1/models/{model}/approve", content=body, headers=head)
        assert refused.status_code in (400, 422) and client.get(MODEL).status_code == 404, percent


def test_limits_are_kept_audited_and_shown(client: httpx.Client, approved: str) -> None:
    limits = {"gain_percent": 10.0, "threshold_percent": 0.0, "time_scale_percent": 60.0}
    shown = client.post(f"/v1/models/{approved}/approve", json={"tracking": limits}).json()
    assert shown["tracking"] == limits and client.get(TRACKING).json()["limits"] == limits
    entries = [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "approve"]
    usual = dict.fromkeys(limits, 20.0)
    assert [entry["detail"]["tracking"] for entry in entries] == [usual, limits]


def test_what_is_not_tracked_stays_and_nothing_tracked_means_no_trial(
    service: Service, client: httpx.Client, approved: str
) -> None:
    client.post(f"/v1/models/{approved}/approve", json={"tracking": {"gain_percent": 0}})
    say(service, values={"gain": 0.85})
    play(client)
    document = tracked(client).json()
    assert document["tracking"]["trial"] == 1 and document["tracking"]["ask"] is None
    assert gain(document, client.get(MODEL).json()) == 1.0
    say(service, values={"gain": 0.79})
    play(client)
    document = tracked(client).json()
    assert "the gain is expected to be 79.0 % of the approved one" in document["tracking"]["ask"], "asked all the same"
    assert gain(document, client.get(MODEL).json()) == 1.0
    nothing = dict.fromkeys(("gain_percent", "threshold_percent", "time_scale_percent"), 0)
    client.post(f"/v1/models/{approved}/approve", json={"tracking": nothing})
    play(client)
    assert trials(client) == [] and tracked(client).content == client.get(MODEL).content


# ---- approvals come and go ----------------------------------------------------------------------------------------


def test_a_new_approval_starts_anew_and_a_rejected_one_serves_nothing(client: httpx.Client, approved: str) -> None:
    play(client)
    assert tracked(client).json()["tracking"]["trial"] == 1
    client.post(f"/v1/models/{approved}/approve")
    assert tracked(client).content == client.get(MODEL).content and trials(client) == []
    play(client)
    document = tracked(client).json()
    assert gain(document, client.get(MODEL).json()) == pytest.approx(0.98)
    client.post(f"/v1/models/{approved}/reject", json={"reason": "no"})
    assert tracked(client).status_code == client.get(MODEL).status_code == 404


def test_undo_ends_what_was_tracked_and_keeps_the_limits(client: httpx.Client, approved: str) -> None:
    child = client.post(f"/v1/models/{approved}/effects", json={"effects": ["fatigue"]}).json()["id"]
    client.post(f"/v1/models/{child}/approve", json={"tracking": {"gain_percent": 15}})
    play(client)
    assert tracked(client).json()["tracking"]["approved_model_id"] == child
    client.post(f"/v1/models/{child}/undo")
    assert tracked(client).content == client.get(MODEL).content
    assert client.get(TRACKING).json()["limits"]["gain_percent"] == 15.0 and trials(client) == []


def test_a_trial_begun_under_an_older_approval_moves_nothing(client: httpx.Client, approved: str) -> None:
    body = {"participant": "P017", "kind": "sequence", "segments": WIDTHS}
    test = client.post("/v1/tests", json=body).json()["id"]
    client.post(f"/v1/models/{approved}/approve")
    wait_done(client, test)
    assert tracked(client).content == client.get(MODEL).content and trials(client) == []


# ---- what goes wrong ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "words"),
    [({"reason": "the model holds for 40 pulses"}, "40 pulses"), ({"die": True}, "while it did the track")],
)
def test_a_trial_that_cannot_be_followed_is_noted_and_nothing_is_lost(
    service: Service, client: httpx.Client, approved: str, wanted: Any, words: str
) -> None:
    play(client)
    before = tracked(client)
    say(service, **wanted)
    assert play(client)["state"] == "completed"
    assert tracked(client).content == before.content
    row = soon(lambda: trials(client)[1:])[0]
    assert row["outcome"] == "not-followed" and words in row["reason"] and row["now"] is None
    play(client)
    document = tracked(client).json()
    assert document["tracking"]["trial"] == 3 and gain(document, client.get(MODEL).json()) == pytest.approx(0.98**2)
    state = service.context.tracked.rows(1)[-1].step["state"]
    assert state["missed"] == 1, "what is known has become less certain by the trial in between"


def test_a_trial_at_another_current_moves_nothing(service: Service, client: httpx.Client, approved: str) -> None:
    client.put("/v1/participants/P017/profile", json={"current_ma": 15.0})
    play(client)
    (row,) = soon(lambda: trials(client))
    assert row["outcome"] == "not-followed" and "another side, muscle or current" in row["reason"]


def test_rates_are_learnt_from_the_same_place(service: Service, client: httpx.Client, approved: str) -> None:
    def sessions() -> int:
        tracked = service.context.tracked
        return len(tracked.earlier(tracked.allowing("P017")))

    play(client)
    assert sessions() == 0
    client.post(f"/v1/models/{approved}/approve")
    assert sessions() == 1, "the approval before this one"
    client.put("/v1/participants/P017/profile", json={"current_ma": 15.0})
    other = run_test(client, "P017")["model_id"]
    assert client.post(f"/v1/models/{other}/approve").status_code == 200
    assert sessions() == 0, "none at this current"


def test_a_damaged_model_is_not_followed(service: Service, client: httpx.Client, approved: str) -> None:
    service.change(Model, approved, document=lambda old: old.replace(b"1", b"2", 1))
    play(client)
    (row,) = soon(lambda: service.context.tracked.rows(1))
    assert row.outcome == "not-followed" and "no longer what was stored" in row.reason
    assert tracked(client).status_code == 500


def test_a_trial_that_is_told_twice_moves_nothing_twice(service: Service, client: httpx.Client, approved: str) -> None:
    test = play(client)
    before, context = tracked(client), service.context
    event = FinishedEvent(test_id=test["id"], outcome="completed", last_sample_unix_s=None)
    for again in (context.runner._finish(event), context.runner.trials.follow(test["id"])):
        service.run(again)
    assert tracked(client).content == before.content and len(trials(client)) == 1


def test_a_slow_worker_keeps_no_test_waiting(service: Service, client: httpx.Client, approved: str) -> None:
    """Who fetches meanwhile gets what was known before."""
    say(service, slow_s=6.0)
    play(client)
    assert trials(client) == [] and tracked(client).content == client.get(MODEL).content
    play(client)
    assert soon(lambda: len(trials(client)) == 2) and tracked(client).json()["tracking"]["trial"] == 2


def test_a_restart_goes_on_where_it_was(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, STUB) as (service, client):
        client.post("/v1/participants", json={"code": "P017"})
        client.post(f"/v1/models/{run_test(client, 'P017')['model_id']}/approve")
        play(client)
        before = tracked(client)
        store = service.context.store
        open_one = play(client)["id"]
        assert tracked(client).json()["tracking"]["trial"] == 2
        with store.write() as session:  # as if the service had been killed before it was followed
            session.delete(session.get(Tracked, open_one))
        assert store.get(Test, open_one).state == "completed"
    with serving(tmp_path, short_dir, STUB) as (_, client):
        soon(lambda: len(trials(client)) == 2)
        document = tracked(client).json()
        assert document["tracking"]["test_id"] == open_one
        assert gain(document, client.get(MODEL).json()) == pytest.approx(0.98**2)
        assert gain(before.json(), client.get(MODEL).json()) == pytest.approx(0.98)
        play(client)
        assert tracked(client).json()["tracking"]["trial"] == 3


# ---- the reference ------------------------------------------------------------------------------------------------


def test_a_reference_tells_the_error_and_changes_nothing_that_is_played(
    service: Service, client: httpx.Client, approved: str
) -> None:
    played = play(client, reference_torque_nm=[1.0] * 40)
    assert tracked(client).status_code == 200 and trials(client)[0]["error_percent"] == 7.5
    plain = play(client)
    assert tracked(client).status_code == 200 and trials(client)[1]["error_percent"] is None
    assert played["planned"] == plain["planned"]
    assert "reference_torque_nm" not in service.rig.last_plan.model_dump()


def test_a_reference_that_does_not_fit_is_refused(service: Service, client: httpx.Client, approved: str) -> None:
    starts = service.rig.starts
    for reference in ([1.0] * 3, [], [1e9] * 3, ["a"], [None], 1.0):
        body = {"participant": "P017", "kind": "sequence", "segments": WIDTHS, "reference_torque_nm": reference}
        assert client.post("/v1/tests", json=body).status_code == 422, reference
        assert client.post("/v1/tests", json={**body, "kind": "pre-session"}).status_code == 422
    assert service.rig.starts == starts


# ---- How far a person lets a model be tracked: what is refused, what is within, and what is said beyond it


def step(outcome: str = "followed", **coming: float) -> dict[str, Any]:
    values = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0} | coming
    levels = {name: {"value": value, "low": value, "high": value} for name, value in values.items()}
    return {"outcome": outcome, "now": levels, "coming": levels, "error_nm": 0.3, "expected_error_nm": 0.05}


@pytest.mark.parametrize("percent", [-0.001, 60.001, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["gain_percent", "threshold_percent", "time_scale_percent"])
def test_what_is_not_from_0_to_60_is_refused(name: str, percent: float) -> None:
    with pytest.raises(ApiError, match=name) as refused:
        Limits(**{name: percent})
    assert refused.value.status == 422


@pytest.mark.parametrize("percent", [0.0, 20.0, 60.0])
def test_the_ends_hold(percent: float) -> None:
    assert Limits(percent, percent, percent).allows == (percent > 0.0)


def test_bounds_are_in_the_quantities_units() -> None:
    assert Limits(20.0, 10.0, 50.0).bounds(80.0) == {
        "gain": (0.8, 1.2), "threshold_shift_us": (-8.0, 8.0), "time_scale": (0.5, 1.5),
    }  # fmt: skip
    assert Limits(0.0, 10.0, 0.0).bounds(80.0) == {"threshold_shift_us": (-8.0, 8.0)}
    assert Limits(0.0, 10.0, 0.0).alarms(80.0) == {
        "gain": (0.8, 1.2), "threshold_shift_us": (-8.0, 8.0), "time_scale": (0.8, 1.2),
    }  # fmt: skip
    for without in (None, 0.0, -3.0):
        assert "threshold_shift_us" not in Limits().bounds(without), "no threshold to be a share of"


@pytest.mark.parametrize(
    ("coming", "words"),
    [
        ({"gain": 0.7999}, "the gain is expected just beyond the 80 to 120 % of the approved one that are allowed."),
        ({"gain": 0.79}, "the gain is expected to be 79.0 % of the approved one; 80 to 120 % are allowed."),
        ({"gain": 1.21}, "121.0 %"),
        ({"threshold_shift_us": 16.01}, "the threshold is expected just beyond the 16 µs that it may move."),
        ({"threshold_shift_us": 16.2}, "the threshold is expected to have moved by +16.2 µs; 16 µs either way are"),
        ({"threshold_shift_us": -17.0}, "-17.0 µs"),
        ({"time_scale": 0.5}, "the time scale is expected to be 50.0 % of the approved one"),
        ({"gain": math.nan}, "it is unknown what to expect of the gain."),
        ({"threshold_shift_us": math.inf}, "it is unknown what to expect of the threshold."),
    ],
)
def test_beyond_a_bound_a_person_is_asked(coming: dict[str, float], words: str) -> None:
    said = tracking.ask(4, step(**coming), Limits().bounds(80.0))
    assert said is not None and words in said and said.endswith(tracking.NEW_TEST)


@pytest.mark.parametrize(
    "coming", [{}, {"gain": 0.8}, {"gain": 1.2}, {"threshold_shift_us": 16.0}, {"time_scale": 0.81}]
)
def test_within_them_nobody_is_asked(coming: dict[str, float]) -> None:
    assert tracking.ask(4, step(**coming), Limits().bounds(80.0)) is None


def test_a_number_that_json_has_not_is_beyond_every_bound() -> None:
    without = step()
    without["coming"] = {**without["coming"], "gain": {"value": None}}
    assert "unknown what to expect of the gain" in str(tracking.ask(1, without, Limits().bounds(80.0)))


def test_what_is_not_tracked_asks_nobody() -> None:
    assert tracking.ask(1, step(gain=0.1), Limits(gain_percent=0.0).bounds(80.0)) is None


def test_next_to_no_torque_asks_for_a_look_at_the_electrodes_first() -> None:
    said = tracking.ask(3, step("no-torque"), Limits().bounds(80.0))
    assert said is not None and said.startswith("In trial 3 the pulses gave next to no torque. Look at the electrodes")
    assert said.endswith(tracking.NEW_TEST)
