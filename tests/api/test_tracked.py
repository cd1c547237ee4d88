"""A controller's trials: each moves what is served within what a person allowed, and nothing beyond that."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, get_args

import httpx
import numpy as np
import pytest
from pydantic import ValidationError

from stimrig.api import local_time
from stimrig.api.errors import ApiError
from stimrig.api.models import tracking
from stimrig.api.models.tracked import TrackedVersions
from stimrig.api.models.tracking import NEW_TEST, OUTCOMES, Limits, sentences
from stimrig.api.sessions import trials as trials_module
from stimrig.api.store.tables import Approval, Model, Recording, Test, Tracked
from stimrig.api.web.responses.models import TrialOut
from stimrig.rig.messages import FinishedEvent
from tests.api import stub_worker
from tests.api.clinic import Clinic
from tests.api.conftest import REAL, STUB, Service, run_test, serving, soon, wait_done

WIDTHS = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [100.0] * 40}}]
MODEL, TRACKING = "/v1/participants/P017/model", "/v1/participants/P017/tracking"


def gain(document: dict[str, Any], approved: dict[str, Any]) -> float:
    return document["recruitment"]["torque_nm"][-1] / approved["recruitment"]["torque_nm"][-1]


# ---- what is kept and served, on the database alone -----------------------------------------------------------------


class Trials(Clinic):
    """Trials that are followed as the stub says."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.tracked = TrackedVersions(self.store, self.clock, self.versions)

    @property
    def approval(self) -> Approval:
        """The newest one."""
        return self.store.first(Approval, Approval.approved, order=Approval.id.desc())

    def begin(self, limits: Limits | None = None, **plan: Any) -> str:
        """A model that a person approves, of a new test."""
        model_id = self.model(**plan).id
        self.approve(model_id, limits or Limits())
        return model_id

    def follow(self, test_id: str = "", **wanted: Any) -> Tracked | None:
        """A trial is played under the approval and followed; `wanted`: what the worker says of it."""
        trial = self.tracked.open_trial(test_id or self.test(approval_id=self.approval.id))
        assert trial is not None
        (self.folder / "track.json").write_text(json.dumps(wanted))
        try:
            arguments = {**self.tracked.arguments(trial), "data": str(self.folder / "trial.h5"), "between": []}
            found = stub_worker.track(lambda *_: None, **arguments)
        except ApiError as error:
            found = {"reason": error.detail}
        return self.tracked.add_trial(trial, found)

    def served(self) -> dict[str, Any]:
        """What the controller is served."""
        found = self.tracked.served("P017")
        assert found is not None
        return json.loads(found.body)

    def plain(self) -> dict[str, Any]:
        """The approved model."""
        found = self.versions.served("P017")
        assert found is not None
        return json.loads(found.body)


@pytest.fixture
def clinic(tmp_path: Path) -> Iterator[Trials]:
    made = Trials(tmp_path)
    yield made
    made.store.close()


GOOD: dict[str, Any] = {}
SHORT = {"reason": "the record is too short"}
ODD = {"outcome": "contradicts", "error_nm": 0.4}
STILL = Limits(gain_percent=0.0)


@pytest.mark.parametrize(
    ("limits", "trials", "trial", "share", "words"),
    [
        (Limits(time_scale_percent=5.0), [GOOD, {"values": {"time_scale": 1.06}}], 1, 0.98, "scale is expected to be"),
        (Limits(), [{"values": {"gain": 1.5}}], 0, 1.0, "the gain is expected to be 150.00 % of the approved one"),
        (Limits(), [GOOD, ODD], 1, 0.98, "Trial 2 contradicts the structure"),
        (Limits(), [GOOD, ODD, GOOD], 3, 0.98**3, None),
        (Limits(), [GOOD, SHORT], 1, 0.98, None),
        (Limits(), [GOOD, SHORT, SHORT], 1, 0.98, "Trials 2 and 3 could not be followed"),
        (Limits(), [GOOD, SHORT, SHORT, GOOD], 4, 0.98**2, None),
        (STILL, [{"values": {"gain": 0.85}}], 1, 1.0, None),
        (STILL, [GOOD, {"values": {"gain": 0.79}}], 1, 1.0, "the gain is expected to be 79.00 % of the approved one"),
    ],
)
def test_beyond_the_limits_the_last_version_within_stays_and_a_person_is_asked(
    clinic: Trials, limits: Limits, trials: list[dict[str, Any]], trial: int, share: float, words: str | None
) -> None:
    """Which words for which limit: below."""
    clinic.begin(limits)
    before, rows = clinic.served(), []
    for wanted in trials:
        before = clinic.served()
        rows.append(clinic.follow(**wanted))
    document, told = clinic.served(), clinic.tracked.document("P017")
    tracking = document["tracking"]
    assert (tracking["trial"], gain(document, clinic.plain())) == (trial, pytest.approx(share))
    assert told and told["ask"] == told["trials"][-1]["ask"] == tracking["ask"]
    assert (tracking["ask"] is None) if words is None else (words in tracking["ask"] and NEW_TEST in tracking["ask"])
    if words and "tracking" in before:
        assert document["recruitment"] == before["recruitment"]
        assert {**tracking, "ask": None} == {**before["tracking"], "ask": None}, "levels and age of what is served"
    if trials[-2:] == [SHORT, GOOD]:
        assert rows[-1].step["state"]["missed"] == 2, "what is known has become less certain"


def test_where_nothing_is_tracked_no_trial_is_followed(clinic: Trials) -> None:
    clinic.begin(Limits(gain_percent=0, threshold_percent=0, time_scale_percent=0))
    assert clinic.tracked.allowing("P017") is None and clinic.served() == clinic.plain()


def test_a_new_approval_starts_anew_and_a_rejected_one_serves_nothing(clinic: Trials) -> None:
    model = clinic.begin()
    clinic.follow()
    begun = clinic.test(approval_id=clinic.approval.id)
    clinic.approve(model, Limits())
    assert clinic.served() == clinic.plain()
    row = clinic.follow(begun)
    assert row and row.outcome == "not-followed" and clinic.served() == clinic.plain(), "begun under the older one"
    clinic.follow()
    assert gain(clinic.served(), clinic.plain()) == pytest.approx(0.98)
    clinic.versions.decide(model, False, "Ada", "no")
    assert clinic.tracked.served("P017") is None is clinic.tracked.document("P017")


def test_rates_are_learnt_from_the_same_place(clinic: Trials) -> None:
    model = clinic.begin()
    clinic.follow()
    assert clinic.tracked.earlier(clinic.approval) == []
    clinic.approve(model, Limits())
    assert len(clinic.tracked.earlier(clinic.approval)) == 1, "the approval before this one"
    clinic.begin(profile={"current_ma": 15.0})
    assert clinic.tracked.earlier(clinic.approval) == [], "none at this current"


def test_a_damaged_model_is_not_followed(clinic: Trials) -> None:
    model = clinic.begin()
    with clinic.store.write() as session:
        row = session.get_one(Model, model)
        row.document, row.etag = row.document.replace(b"1", b"2", 1), hashlib.sha256(row.document).hexdigest()
    tracked = clinic.follow()
    assert tracked and tracked.outcome == "not-followed" and "no longer what was stored" in tracked.reason


# ---- through the service --------------------------------------------------------------------------------------------


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


def test_each_trial_moves_it_and_the_approved_one_never_changes(client: httpx.Client, approved: str) -> None:
    before, followed = client.get(MODEL), tracked(client)
    assert followed.content == before.content and followed.headers["etag"] == before.headers["etag"], "no trial yet"
    assert "last-modified" in followed.headers and "last-modified" not in before.headers
    assert trials(client) == [] and client.get(TRACKING).json()["served_trial"] == 0
    tags = {before.headers["etag"]}
    for number in (1, 2):
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
    assert len(tags) == 3
    after = client.get(MODEL)
    assert after.content == before.content and dict(after.headers) | {"date": ""} == dict(before.headers) | {"date": ""}
    assert [row["number"] for row in trials(client)] == [1, 2]
    entries = [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "track model"]
    assert len(entries) == 2 and all(entry["subject"] == approved for entry in entries)


def test_without_an_approval_nothing_is_served_or_noted(client: httpx.Client, participant: str) -> None:
    run_test(client, participant)
    play(client)
    assert tracked(client).status_code == client.get(TRACKING).status_code == 404
    assert client.get("/v1/participants/P999/tracking").json()["title"] == "No such participant"


def test_a_tracked_version_foretells_a_trial(client: httpx.Client, approved: str) -> None:
    play(client)
    tracked_id = tracked(client).json()["model_id"]
    unknown = (f"{approved}.99.0", f"{approved}.0.0", "none.1.0")  # no such approval of that model
    never = (f"{approved}.1.2", f"{approved}.2.1", "none.1.1", f"{approved}.1.{'9' * 30}", ".1.1", *unknown)
    for verb, body in (("prediction", {"pulse_width_us": [100.0]}), ("widths", {"reference_torque_nm": [0.0, 1.0]})):
        for model_id in (approved, tracked_id, f"{approved}.1.0"):
            assert client.post(f"/v1/models/{model_id}/{verb}", json=body).json()["model_id"] == model_id
        for model_id in never:
            assert client.post(f"/v1/models/{model_id}/{verb}", json=body).status_code == 404


def test_limits_are_refused_or_kept_audited_and_shown(client: httpx.Client, participant: str) -> None:
    model, head = run_test(client, participant)["model_id"], {"Content-Type": "application/json"}
    for percent in ("-1", "60.5", '"20"', "null", "true", "1e400"):
        body = f'{{"tracking": {{"gain_percent": {percent}}}}}'
        refused = client.post(f"/v1/models/{model}/approve", content=body, headers=head)
        assert refused.status_code in (400, 422) and client.get(MODEL).status_code == 404, percent
    limits = {"gain_percent": 10.0, "threshold_percent": 0.0, "time_scale_percent": 60.0}
    shown = client.post(f"/v1/models/{model}/approve", json={"tracking": limits}).json()
    assert shown["tracking"] == limits and client.get(TRACKING).json()["limits"] == limits
    client.post(f"/v1/models/{model}/approve")
    entries = [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "approve"]
    usual = dict.fromkeys(limits, 20.0)
    assert sorted(str(entry["detail"]["tracking"]) for entry in entries) == sorted(map(str, (limits, usual)))


def test_a_worker_that_dies_or_another_current_costs_the_trial_only(
    service: Service, client: httpx.Client, approved: str
) -> None:
    say(service, die=True)
    assert play(client)["state"] == "completed"
    assert tracked(client).content == client.get(MODEL).content
    client.put("/v1/participants/P017/profile", json={"current_ma": 15.0})
    play(client)
    rows = soon(lambda: len(found := trials(client)) == 2 and found)
    assert [row["outcome"] for row in rows] == ["not-followed"] * 2 and rows[0]["now"] is None
    assert "while it did the track" in rows[0]["reason"] and "another side, muscle or current" in rows[1]["reason"]


def test_a_trial_that_is_told_twice_moves_nothing_twice(service: Service, client: httpx.Client, approved: str) -> None:
    test = play(client)
    before, context = tracked(client), service.context
    event = FinishedEvent(test_id=test["id"], outcome="completed", last_sample_unix_s=None)
    for again in (context.runner._finish(event), context.runner.trials.follow(test["id"])):
        service.run(again)
    assert tracked(client).content == before.content and len(trials(client)) == 1


def test_a_slow_worker_keeps_no_test_waiting(
    service: Service, client: httpx.Client, approved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who fetches meanwhile gets what was known before."""
    monkeypatch.setattr(trials_module, "PATIENCE_S", 0.2)
    say(service, slow_s=3.0)
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
    played, plain = play(client, reference_torque_nm=[1.0] * 40), play(client)
    assert [trial["error_percent"] for trial in trials(client)] == [7.5, None]
    assert played["planned"] == plain["planned"]
    assert service.rig.last_plan is not None and "reference_torque_nm" not in service.rig.last_plan.model_dump()
    starts = service.rig.starts
    for reference in ([1.0] * 3, [], [1e9] * 3, ["a"], [None], 1.0):
        body = {"participant": "P017", "kind": "sequence", "segments": WIDTHS, "reference_torque_nm": reference}
        assert client.post("/v1/tests", json=body).status_code == 422, reference
        assert client.post("/v1/tests", json={**body, "kind": "pre-session"}).status_code == 422
    assert service.rig.starts == starts


# ---- How far a person lets a model be tracked: what is refused, what is within, and what is said beyond it


def step(outcome: str = "followed", **coming: float | None) -> dict[str, Any]:
    values = {"gain": 1.0, "threshold_shift_us": 0.0, "time_scale": 1.0} | coming
    levels = {name: {"value": value, "low": value, "high": value} for name, value in values.items()}
    return {"outcome": outcome, "now": levels, "coming": levels, "error_nm": 0.3, "expected_error_nm": 0.05}


@pytest.mark.parametrize("percent", [-0.001, 60.001, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["gain_percent", "threshold_percent", "time_scale_percent"])
def test_what_is_not_from_0_to_60_is_refused(name: str, percent: float) -> None:
    with pytest.raises(ValidationError, match=name):
        Limits(**{name: percent})


def test_bounds_are_in_the_quantities_units() -> None:
    assert Limits(threshold_percent=10.0, time_scale_percent=50.0).bounds(80.0) == {
        "gain": (0.8, 1.2), "threshold_shift_us": (-8.0, 8.0), "time_scale": (0.5, 1.5),
    }  # fmt: skip
    threshold_alone = Limits(gain_percent=0.0, threshold_percent=10.0, time_scale_percent=0.0)
    assert threshold_alone.bounds(80.0) == {"threshold_shift_us": (-8.0, 8.0)}
    assert threshold_alone.alarms(80.0) == {
        "gain": (0.8, 1.2), "threshold_shift_us": (-8.0, 8.0), "time_scale": (0.8, 1.2),
    }  # fmt: skip
    for without in (None, 0.0, -3.0):
        assert "threshold_shift_us" not in Limits().bounds(without), "no threshold to be a share of"


@pytest.mark.parametrize(
    ("coming", "words"),
    [
        ({"gain": 0.7999}, "the gain is expected to be 79.99 % of the approved one; 80 to 120 % are allowed."),
        ({"gain": 1.21}, "121.00 %"),
        ({"threshold_shift_us": 16.01}, "is expected to have moved by +16.01 µs; 16.00 µs either way are allowed."),
        ({"threshold_shift_us": -17.0}, "-17.00 µs"),
        ({"time_scale": 0.5}, "the time scale is expected to be 50.00 % of the approved one"),
        ({"gain": math.nan}, "it is unknown what to expect of the gain."),
        ({"gain": None}, "it is unknown what to expect of the gain."),
        ({"threshold_shift_us": math.inf}, "it is unknown what to expect of the threshold."),
    ],
)
def test_beyond_a_bound_a_person_is_asked(coming: dict[str, Any], words: str) -> None:
    said = tracking.new_test_reason(4, step(**coming), Limits().bounds(80.0))
    assert said is not None and words in said and said.endswith(tracking.NEW_TEST)


@pytest.mark.parametrize(
    "coming", [{}, {"gain": 0.8}, {"gain": 1.2}, {"threshold_shift_us": 16.0}, {"time_scale": 0.81}]
)
def test_within_them_nobody_is_asked(coming: dict[str, float]) -> None:
    assert tracking.new_test_reason(4, step("followed", **coming), Limits().bounds(80.0)) is None


def test_next_to_no_torque_asks_for_a_look_at_the_electrodes_first() -> None:
    said = tracking.new_test_reason(3, step("no-torque"), Limits().bounds(80.0))
    assert said is not None and said.startswith("In trial 3 the pulses gave next to no torque. Look at the electrodes")
    assert said.endswith(tracking.NEW_TEST)


# ---- The page of a participant while a controller plays trials: what is seen, without reload, and what is asked.


PAGE = "/participants/P017"


def trial(number: int = 1, distance: float | None = 2.0, **levels: tuple[float, float, float]) -> dict[str, Any]:
    usual = {"gain": (1.0, 0.96, 1.04), "threshold_shift_us": (0.0, -1.0, 1.0), "time_scale": (1.0, 0.95, 1.05)}
    now = {name: dict(zip(("value", "low", "high"), level, strict=True)) for name, level in (usual | levels).items()}
    at_utc = "2026-11-22T12:00:00.000Z"
    return {"number": number, "now": now, "at_utc": at_utc, "outcome": "followed", "distance": distance}


SINCE = "2026-11-22T11:05:00.000Z"


@pytest.mark.parametrize(
    ("levels", "words"),
    [
        ({"gain": (0.77, 0.75, 0.79)}, "In trial 2 the plateau is 23.0 % lower than on {}."),
        ({"gain": (1.052, 1.01, 1.09)}, "In trial 2 the plateau is 5.2 % higher than on {}."),
        ({"threshold_shift_us": (-3.0, -4.0, -2.0)}, "In trial 2 the threshold is 3.0 µs lower than on {}."),
        ({"time_scale": (1.2, 1.1, 1.3)}, "In trial 2 the muscle is 20.0 % slower than on {}."),
        ({}, "By trial 2 no change since {} is certain."),
        ({"gain": (0.77, 0.5, 1.01)}, "By trial 2 no change since {} is certain."),
    ],
)
def test_only_what_the_bands_are_sure_of_is_said(levels: Any, words: str) -> None:
    (said,) = sentences([trial(), trial(2, **levels)], SINCE)
    assert said == words.format(local_time.when(SINCE))


def test_a_trial_that_taught_the_model_nothing_changes_no_sentence() -> None:
    """What is known after it is what was expected before."""
    learnt = trial(1, gain=(0.8, 0.78, 0.82))
    for outcome in ("odd", "contradicts", "no-torque"):
        unexplained = {**trial(2, distance=None, gain=(0.7, 0.6, 0.75)), "outcome": outcome}
        assert sentences([learnt, unexplained], SINCE) == sentences([learnt], SINCE), outcome
        assert sentences([unexplained], SINCE) == []


def test_every_outcome_of_the_service_has_words() -> None:
    told = get_args(TrialOut.model_fields["outcome"].annotation)
    assert set(told) == set(OUTCOMES)
    assert len(set(OUTCOMES.values())) == len(told)


@pytest.mark.browser
def test_the_card_is_renewed_while_trials_are_played(service: Service, client: httpx.Client, approved: str, tab: Any):
    # while a trial runs something else is next, and the page would be loaded anew
    tab.goto(service.url + PAGE)

    def same_line(route: Any) -> None:
        route.fulfill(json={**route.fetch().json(), "key": tab.locator("#next").get_attribute("data-next-key")})

    tab.route(f"**{PAGE}/next", same_line)
    tab.evaluate("window.same = true")
    for number in (1, 2):
        play(client)
        tab.get_by_text(f"as of trial {number},").wait_for()
    assert tab.evaluate("window.same") is True, "without reload"
    tab.get_by_text("All trials as a table").click()
    say(service, values={"gain": 0.7})
    play(client)
    asked = tab.locator("#trials .notice")
    asked.wait_for()
    tab.reload()
    tab.get_by_text("See why").wait_for()
    table = tab.locator("#trials details")
    table.locator("summary").click()
    say(service, reason="the record is too short")
    play(client)
    tab.get_by_text("the record is too short").wait_for()
    assert tab.evaluate("document.activeElement.tagName") == "SUMMARY", "who opened the table stays there"
    assert asked.get_attribute("role") is None, "the same question is read aloud once"
    tab.unroute_all(behavior="ignoreErrors")
    tab.get_by_role("button", name="Start the adaptive test").first.click()
    tab.get_by_role("button", name="Start now").wait_for()
    assert tab.errors == []


# ---- The worker's side of tracking, with identify itself: recordings in, the model for the next trial out.


# ---- What the muscle did between two trials: the service passes it on, the worker carries its effects through it


def passed_on(service: Service, approval_id: int) -> list[list[str]]:
    """For each trial that was followed, the recordings that the worker was given beside its own."""
    store = service.context.store
    names = {row.path: row.id for row in store.all(Recording)}
    rows = service.context.tracked.rows(approval_id)
    return [[names[path] for path in row.step["state"]["between"]] for row in rows if row.step is not None]


def test_the_worker_is_given_what_was_played_since(service: Service, client: httpx.Client, participant: str) -> None:
    tested = run_test(client, participant)
    plain = tested["model_id"]
    assert client.post(f"/v1/models/{plain}/approve").status_code == 200
    first = play(client)
    soon(lambda: passed_on(service, 1) == [[]])  # a model without effects
    added = client.post(f"/v1/models/{plain}/effects", json={"effects": ["fatigue"]}).json()["id"]
    assert client.post(f"/v1/models/{added}/approve").status_code == 200
    play(client)
    say(service, reason="It cannot be read.")
    missed = play(client)
    client.put(f"/v1/participants/{participant}/profile", json={"current_ma": 15.0})
    play(client)  # at another current: nobody knows how much it tires
    client.put(f"/v1/participants/{participant}/profile", json={"current_ma": 20.0})
    play(client)
    play(client)
    expected = [[tested["recording_id"], first["recording_id"]], [missed["recording_id"]], []]
    soon(lambda: passed_on(service, 2) == expected)


# ---- from a trial to the tracked model that is served; nothing is stubbed but the rig ----------------------------

PERSON = "/v1/participants/P1"
TRIAL_US = np.r_[np.zeros(40), np.linspace(0, 160, 100), np.full(60, 160.0), np.linspace(160, 0, 100), np.zeros(40)]
TRIAL = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": TRIAL_US.round().tolist()}}]
BODY = {"participant": "P1", "kind": "sequence", "segments": TRIAL}


def test_a_muscle_that_stays_is_followed_through_the_service(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, REAL) as (_, client):
        client.timeout = 300
        client.post("/v1/participants", json={"code": "P1"})
        test = run_test(client, "P1", 300)
        assert client.post(f"/v1/models/{test['model_id']}/approve").status_code == 200
        for number in (1, 2):
            wait_done(client, client.post("/v1/tests", json=BODY).json()["id"], 300)
            served = client.get(f"{PERSON}/model", params={"tracked": True})
            for _ in range(60):  # a fetch waits two seconds at most, and the first trial may wait for the worker
                if served.json().get("tracking", {}).get("trial") == number:
                    break
                served = client.get(f"{PERSON}/model", params={"tracked": True})
        document, plain = served.json(), client.get(f"{PERSON}/model").json()
        told = document["tracking"]
        (one, two) = client.get(f"{PERSON}/tracking").json()["trials"]
        assert told["trial"] == 2 and told["ask"] is None and two["outcome"] == "followed", (one, two)
        gain = told["now"]["gain"]
        assert gain["low"] < 1.0 < gain["high"] and gain["high"] - gain["low"] < 0.2
        moved, approved = (np.array(d["recruitment"]["torque_nm"]) for d in (document, plain))
        assert moved[-1] / approved[-1] == pytest.approx(told["coming"]["gain"]["value"], abs=0.02)
        assert parsedate_to_datetime(served.headers["last-modified"]).isoformat()[:19] == two["at_utc"][:19]
        wanted = {"reference_torque_nm": np.r_[np.zeros(20), np.full(60, 1.0)].tolist()}
        widths = client.post(f"/v1/models/{document['model_id']}/widths", json=wanted)
        assert widths.status_code == 200, widths.text
        assert widths.json()["predicted_torque_nm"][-1] == pytest.approx(1.0, abs=0.1)
