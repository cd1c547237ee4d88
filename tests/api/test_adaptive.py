"""Tests that stop themselves, through the service, on a fake rig with a made-up adviser."""

from __future__ import annotations

import asyncio
import re
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import httpx
import numpy as np
import pytest
from pydantic import ValidationError

from stimrig import identify
from stimrig.api.errors import ApiError
from stimrig.api.jobs import adaptive as verbs
from stimrig.api.jobs.job import Job
from stimrig.api.sessions import adaptive_follower
from stimrig.api.sessions.adaptive import AdaptiveTests
from stimrig.api.sessions.adaptive_follower import AdaptiveStatus, Follower
from stimrig.api.sessions.kinds import Planned
from stimrig.api.sessions.requests import TargetIn, TestIn
from stimrig.api.sessions.rig_client import no_rig
from stimrig.api.store.tables import Test
from stimrig.identify.experiments.knowledge import LEAST_PERCENT, MOST_PERCENT, Target
from stimrig.rig import messages as m
from stimrig.rig.messages import LiveEvent, PulseOutcomes, SegmentPlan
from stimrig.rig.requests import EnoughRequest, ExtendRequest
from tests.api.browser import participant
from tests.api.conftest import Service, own_service, soon, wait_done
from tests.harness.adaptive import PULSE_RATE_HZ, recorded, sigmoid

service = own_service(speed=1.0)
"""Adaptive tests are decided in seconds of the rig: it plays at the speed of the world."""


def start(client: httpx.Client, **more: Any) -> httpx.Response:
    return client.post("/v1/tests", json={"participant": "P017", "kind": "adaptive", **more})


def played(client: httpx.Client, **more: Any) -> dict[str, Any]:
    started = start(client, **more)
    assert started.status_code == 202, started.text
    return wait_done(client, started.json()["id"])


def test_a_test_stops_itself_once_enough_is_known(client: httpx.Client, service: Service, participant: str) -> None:
    document = played(client)
    assert document["state"] == "completed" and document["model_id"]
    adaptive = document["adaptive"]
    assert (adaptive["state"], adaptive["ended"], adaptive["problem"]) == ("ended", "known-enough", "")
    assert adaptive["reach"]["reachable"] and not adaptive["reach"]["known"]
    assert adaptive["knowledge"]["curve_percent"] <= adaptive["target"]["curve_percent"] == 2.0
    laid = [row["kind"] for row in adaptive["decisions"] if row["sample_to_plan_ms"] is not None]
    assert laid[0] == "next" and laid[-1] == "enough"
    assert document["summary"]["duration_s"] < 38.7
    with service.context.store.read() as session:
        plan = session.get(Test, document["id"]).plan
    assert plan["adaptive"] == {"max_duration_s": 50.0, "max_torque_time_nms": 360.0, "patience_s": 3.0}
    assert "key" not in plan and service.rig.key not in str(plan)


def test_only_new_samples_are_sent_and_none_is_lost(client: httpx.Client, service: Service, participant: str) -> None:
    """The adviser is busy at first: a record without its beginning would mislead."""
    advised: list[dict[str, Any]] = []
    adviser = service.context.runner.adaptive.adviser
    submit = adviser.submit

    def listening(verb: str, **arguments: Any) -> Job:
        if verb == "adaptive_advise":
            advised.append(arguments)
        if verb == "adaptive_begin":
            submit("busy", seconds=1.5)
        return submit(verb, **arguments)

    adviser.submit = listening
    assert played(client)["adaptive"]["ended"] == "known-enough"
    counters = [row[3] for arguments in advised for row in m.TORQUE_ROW.iter_unpack(arguments["samples"])]
    assert counters == list(range(len(counters))) and len(counters) > 800
    assert all(len(arguments["laid_us"]) == arguments["segments"][-1][2] for arguments in advised)
    assert advised[-1]["laid_us"][-40:] == [100.0, 200.0] * 20


def test_a_model_of_another_arm_or_current_says_nothing_of_this_one(
    client: httpx.Client, service: Service, participant: str
) -> None:
    def known(**more: Any) -> bool:
        body = {"participant": "P017", "kind": "adaptive", **more}
        return client.post("/v1/preview", json=body).json()["reach"]["known"]

    assert client.put("/v1/participants/P017/muscle", json={"side": "left", "muscle": "biceps"}).status_code == 200
    document = played(client)
    assert client.post(f"{document['model_url']}/approve", json={"reason": "good fit"}).status_code == 200
    assert known()
    assert not known(profile={"current_ma": 10.0})
    client.put("/v1/participants/P017/muscle", json={"side": "right", "muscle": "biceps"})
    assert not known()


def test_enough_ends_it_well_at_any_time(client: httpx.Client, service: Service, participant: str) -> None:
    test_id = start(client, target={"curve_percent": 0.2, "step_percent": 0.2}).json()["id"]
    soon(lambda: client.get(f"/v1/tests/{test_id}").json()["elapsed_s"] > 1)
    answer = client.post(f"/v1/tests/{test_id}/enough")
    assert answer.status_code == 200 and answer.json()["ended_by"] == "enough"
    document = wait_done(client, test_id)
    assert (document["state"], document["adaptive"]["ended"]) == ("completed", "enough")
    assert document["summary"]["duration_s"] == pytest.approx(answer.json()["boundary_s"])
    late = client.post(f"/v1/tests/{test_id}/enough")
    assert late.status_code == 409 and late.json()["type"] == "/problems/rig-late"


def test_a_broken_link_leaves_the_test_to_its_fixed_plan(
    client: httpx.Client, service: Service, participant: str
) -> None:
    test_id = start(client, target={"curve_percent": 0.2, "step_percent": 0.2}).json()["id"]

    def adaptive() -> dict[str, Any]:
        return client.get(f"/v1/tests/{test_id}").json()["adaptive"]

    soon(lambda: client.get(f"/v1/tests/{test_id}").json()["elapsed_s"] > 1)
    assert adaptive()["state"] == "choosing"
    service.rig_thread.cut_link()
    soon(lambda: adaptive()["state"] == "fixed", 10)
    assert "closed the connection" in adaptive()["problem"]
    client.post("/v1/stop")


def test_out_of_reach_is_said_before_the_first_pulse(client: httpx.Client, service: Service, participant: str) -> None:
    refused = start(client, max_torque_time_nm_s=10.0)
    assert refused.status_code == 422 and refused.json()["type"] == "/problems/out-of-reach"
    assert "6.0 %" in refused.json()["detail"] and refused.json()["reach"]["curve_percent"] == 6.0
    assert service.rig.starts == 0
    assert start(client, max_torque_time_nm_s=10.0, anyway=True).status_code == 202
    client.post("/v1/stop")


@pytest.mark.parametrize(
    ("more", "place"),
    [
        ({"target": {"curve_percent": -1}}, ("target", "curve_percent")),
        ({"target": {"curve_percent": "2"}}, ("target", "curve_percent")),
        ({"target": {"curve_percent": float("nan")}}, ("target", "curve_percent")),
        ({"target": {"step_percent": True}}, ("target", "step_percent")),
        ({"target": {"curve": 2}}, ("target", "curve")),
        ({"max_duration_s": 0}, ("max_duration_s",)), ({"max_torque_time_nm_s": -3}, ("max_torque_time_nm_s",)),
        ({"kind": "pre-session", "target": {"curve_percent": 3}}, ()),
        ({"segments": [{"name": "a", "sequence": "rest"}]}, ()),
    ],
)  # fmt: skip
def test_what_is_no_target_is_refused_by_its_place(more: dict[str, Any], place: tuple[str, ...]) -> None:
    with pytest.raises(ValidationError) as refused:
        TestIn.model_validate({"participant": "P017", "kind": "adaptive", **more})
    assert refused.value.errors()[0]["loc"] == place


def test_the_bounds_of_a_target_are_those_of_identify() -> None:
    assert TargetIn().model_dump() == {"curve_percent": Target().curve_percent, "step_percent": Target().step_percent}
    for name in TargetIn.model_fields:
        TargetIn.model_validate({name: LEAST_PERCENT})
        TargetIn.model_validate({name: MOST_PERCENT})
        for outside in (0.99 * LEAST_PERCENT, 1.01 * MOST_PERCENT):
            with pytest.raises(ValueError, match=name):
                TargetIn.model_validate({name: outside})


@pytest.fixture
def adaptive() -> AdaptiveTests:
    return AdaptiveTests(*([MagicMock()] * 5))


def row(planned: tuple[str, ...] = ("opening", "prbs", "validate"), **summary: Any) -> Test:
    bounds = {"max_duration_s": 45.0, "max_torque_time_nms": 360.0, "patience_s": 3.0}
    segments = [{"name": name, "start_s": 0.0, "end_s": 1.0} for name in planned]
    plan = {"adaptive": bounds, "target": {}, "reach": None, "preview": {"segments": segments}}
    return Test(id="T1", participant="P017", kind="adaptive", state="running", plan=plan, summary=summary)


@pytest.mark.parametrize(
    ("by", "duration_s", "ended"),
    [("plan", 42.0, "fixed-rest"), ("torque_time", 9.0, "torque-time"), ("limit", 44.4, "time"),
     ("limit", 20.0, "limit"), ("enough", 9.0, "enough"), ("stopped", 9.0, "stopped")],
)  # fmt: skip
def test_the_end_is_told_by_its_cause(adaptive: AdaptiveTests, by: str, duration_s: float, ended: str) -> None:
    summary = {"ended_by": by, "duration_s": duration_s, "torque_time_nms": 8.0}
    event = m.FinishedEvent(test_id="T1", outcome="completed", last_sample_unix_s=None, summary=summary)
    told = adaptive.outcome(row(), event)["adaptive"]
    assert (told["ended"], told["torque_time_nm_s"], told["state"]) == (ended, 8.0, "ended")


@pytest.mark.parametrize(("state", "why"), [("running", "the service was restarted"), ("requested", "")])
def test_a_test_that_nobody_watches_says_so(adaptive: AdaptiveTests, state: str, why: str) -> None:
    test = row()
    test.state = state
    problem = adaptive.document(test)["problem"]
    assert why in problem and bool(problem) is bool(why)


@pytest.mark.parametrize(
    ("ended", "planned", "helped"),
    [("known-enough", ("opening", "validate"), True), ("fixed-rest", ("opening", "prbs", "validate"), False),
     ("fixed-rest", ("opening", "prbs"), True)],
)  # fmt: skip
def test_only_a_whole_fixed_test_is_fitted_like_one(
    adaptive: AdaptiveTests, ended: str, planned: tuple[str, ...], helped: bool
) -> None:
    assert bool(adaptive.fit_options(row(planned, adaptive={"ended": ended}))) == helped


# ---- Following a test that stops itself, without a rig and without time: when it asks and answers, what goes wrong


FIRST_S = 3.0
NEXT = {"name": "hold 2", "sequence": "widths", "settings": {"pulse_width_us": [100.0] * 10, "jumps": True}}
SAID: dict[str, Any] = {
    "kind": "next", "segments": [NEXT], "words": "Known a little.", "expected_torque_time_nm_s": 1.0,
    "knowledge": None, "least_known": None,
}  # fmt: skip


class World:
    """Clock, rig and adviser in one: the time is that of the newest event. An answer of None never comes, one that is
    late after the boundary."""

    path, laid, connected = None, 30, True

    def __init__(self, *answers: Any, refusal: ApiError | None = None) -> None:
        self.now_s, self.answers, self.refusal = 0.0, list(answers), refusal
        self.requests: list[tuple[float, Any]] = []
        self.asked: list[dict[str, Any]] = []

    def monotonic_s(self) -> float:
        return self.now_s

    async def ask(self, request: Any) -> dict[str, Any]:
        self.requests.append((self.now_s, request))
        if self.refusal is not None and request.segments:
            raise self.refusal
        return {}

    def submit(self, kind: str, **arguments: Any) -> Any:
        return SimpleNamespace(result=self.answer(kind, arguments))

    async def answer(self, kind: str, arguments: dict[str, Any]) -> dict[str, Any]:
        if kind == "adaptive_begin":
            return {}
        self.asked.append(arguments)
        if (answer := self.answers.pop(0) if self.answers else None) is None:
            await asyncio.Event().wait()
        if isinstance(answer, ApiError):
            raise answer
        while answer.get("late") and self.laid == 30:
            await asyncio.sleep(0)
        return answer

    async def play(self, follower: Follower) -> None:
        follower.start()
        while self.now_s < FIRST_S:
            self.now_s += 0.02
            self.laid = 30 if self.now_s < FIRST_S - 0.05 else 50
            follower.take(LiveEvent(
                test_id="T1", segment="opening", elapsed_s=self.now_s, duration_s=45.0, zero_s=0.0, torque="",
                torque_age_s=0.0, lost_samples=0, dropped_pulses=0, laid=self.laid,
                boundary_s=FIRST_S + (self.laid - 30),
                outcomes=PulseOutcomes(
                    index=[4], pulse_width_us=[0.0], written_time_s=[None], acknowledged_time_s=[None], status=[2]
                ),
                laid_segments=[m.LaidSegment(name="opening", start_s=0.0, end_s=FIRST_S, by="plan")],
            ))  # fmt: skip
            for _ in range(5):
                await asyncio.sleep(0)
        await follower.tasks.close()


def follower_of(world: World, rate_hz: float = 40.0) -> Follower:
    opening = SegmentPlan(name="opening", sequence="widths", settings={"pulse_width_us": [0.0] * round(3 * rate_hz)})
    plan = m.TestPlan(
        test_id="T1", participant="P017",
        profile=m.Profile(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0),
        segments=[opening], pulse_rate_hz=rate_hz,
        adaptive=m.AdaptivePlan(max_duration_s=45.0, max_torque_time_nms=360.0),
    )  # fmt: skip
    whole: Any = world
    return Follower(Planned(plan), AdaptiveTests(whole, whole, MagicMock(), whole, MagicMock()), whole)


def followed(world: World, rate_hz: float = 40.0) -> AdaptiveStatus:
    follower = follower_of(world, rate_hz)
    asyncio.run(world.play(follower))
    return follower.status


@pytest.mark.parametrize("rate_hz", [10.0, 40.0])
def test_the_answer_is_sent_at_once_and_before_the_rig_decides(rate_hz: float) -> None:
    world = World(SAID)
    assert followed(world, rate_hz).problem == ""
    [(at_s, request)] = world.requests
    assert isinstance(request, ExtendRequest) and request.after == 30
    assert at_s == pytest.approx(FIRST_S - m.AHEAD / rate_hz - adaptive_follower.ASK_S, abs=0.03)


def test_an_answer_for_a_boundary_that_has_passed_is_noted_and_not_sent() -> None:
    world = World({**SAID, "late": True})
    status = followed(world)
    assert [row["late"] for row in status.decisions] == [True] and world.requests == []


def test_the_end_is_told_with_what_it_was_decided_on() -> None:
    known = {"curve_percent": 1.5, "step_percent": 1.0}
    world = World({**SAID, "kind": "enough", "segments": [], "knowledge": known})
    status = followed(world)
    assert [type(request) for _, request in world.requests] == [EnoughRequest]
    assert (status.ended, status.knowledge, len(world.asked)) == ("known-enough", known, 1)


def test_the_adviser_is_told_what_became_of_all_pulses() -> None:
    world = World(SAID)
    followed(world)
    told = world.asked[0]["outcomes"]
    assert set(told["index"]) == {4} and set(told["status"]) == {2} and len(told["index"]) > 100, "all since the start"
    assert told.keys() == PulseOutcomes.model_fields.keys()


@pytest.mark.parametrize(("rate_hz", "least_s"), [(10.0, 2.2), (40.0, 2.05)])
def test_no_question_is_asked_before_the_record_is_long_enough(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float, least_s: float
) -> None:
    """Of slow pulses the last whole one may have begun long ago; the answer would be the first look once more."""
    monkeypatch.setattr(adaptive_follower, "ASK_S", 2.0)
    world = World(SAID)
    followed(world, rate_hz)
    assert world.asked[0]["measured_s"] == pytest.approx(least_s, abs=0.03)


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ({**SAID, "segments": [{**NEXT, "settings": {}}]}, "KeyError"),
        ({**SAID, "kind": "misfit", "segments": []}, "Known a little."),
        ({}, "KeyError"),
        (ApiError(503, "worker-died", "Worker died", "The worker process died."), "The worker process died"),
    ],
)
def test_an_answer_that_cannot_be_used_is_told_and_the_fixed_plan_plays_at_once(answer: Any, why: str) -> None:
    world = World(answer)
    status = followed(world)
    assert status.state == "fixed" and status.problem.startswith("The fixed plan plays on: ") and why in status.problem
    assert [(request.after, request.segments) for _, request in world.requests] == [(30, [])]


def test_what_the_rig_refuses_is_noted_and_the_fixed_plans_next_piece_plays() -> None:
    world = World(SAID, refusal=ApiError(409, "rig-late", "Too late", "More was laid."))
    status = followed(world)
    assert (status.state, status.decisions[0]["refused"], len(world.requests)) == ("choosing", "More was laid.", 1)


def test_a_lost_answer_of_the_rig_ends_in_the_fixed_plan() -> None:
    """Whether the rig laid it is not known; a record with the wrong widths would mislead."""
    world = World(SAID, refusal=no_rig("It did not answer within 5 s."))
    status = followed(world)
    assert status.state == "fixed" and "did not answer" in status.problem
    assert [request.segments for _, request in world.requests][1:] == [[]], "it plays on at once"


@pytest.mark.parametrize("connected", [True, False])
def test_samples_that_are_missed_end_in_the_fixed_plan(connected: bool) -> None:
    """The link breaks, or is down from the beginning."""
    world = World()
    world.connected = connected
    follower = follower_of(world)

    async def lose_the_link() -> None:
        follower.kind.watch(follower)
        if connected:
            follower.kind.hear(None)
        await asyncio.sleep(0)
        await follower.tasks.close()

    asyncio.run(lose_the_link())
    assert follower.status.state == "fixed" and "closed the connection" in follower.status.problem
    assert not follower.listens and [request.segments for _, request in world.requests] == [[]]


# ---- What the adviser's worker keeps between its jobs, and which models it takes -------------------------------------


BEGIN: dict[str, Any] = {
    "target": {"curve_percent": 4.0, "step_percent": 4.0}, "playable_s": 44.0, "max_torque_time_nm_s": 360.0,
    "largest_us": 300.0, "pulse_rate_hz": PULSE_RATE_HZ,
}  # fmt: skip


def test_a_model_that_cannot_be_read_here_keeps_nobody_from_a_test() -> None:
    widths = np.array([0.0] * 20 + [7.5 * k for k in range(1, 41)] + [300.0] * 12 + [0.0] * 36 + [150.0] * 80)
    noise_nm = 0.05 * np.random.default_rng(3).standard_normal(4000)
    record = recorded(sigmoid(74), widths, ["opening"] * widths.size, noise_nm)
    readable = identify.fit(record, recruitment="near-sigmoid").to_json()
    assert verbs.known(["{}", readable]).model.to_json() == readable
    assert verbs.known([readable, "{}"]) is verbs.known(["no JSON"]) is None  # an older one is not the last one


def test_a_begin_that_failed_leaves_no_test_to_advise() -> None:
    """Nor does the end of the worker's process, in which the test was."""

    def quiet(*_: object) -> None: ...

    assert verbs.adaptive_begin(quiet, **BEGIN) == {}
    with pytest.raises(TypeError):
        verbs.adaptive_begin(quiet, **BEGIN, models=7)
    with pytest.raises(RuntimeError, match="started again during the test"):
        verbs.adaptive_advise(quiet)


# ---- The pages of a test that stops itself: the choice, the question, what is known by now, Enough.


@pytest.mark.browser
def test_a_test_that_stops_itself_on_its_page(tab: Any, service: Service) -> None:
    service.rig.speed = 0.25  # slow enough to look at it from all sides
    participant(tab, service, "X1")
    tab.locator("[name=kind][value=adaptive]").check()
    tab.locator("[name=target]").fill("0,2")
    tab.locator("button.stimulate").first.click()
    tab.get_by_text("The target should be reached").wait_for()
    tab.locator("form.steps button.stimulate").click()
    tab.locator("#knows").wait_for()
    service.rig.speed = 1.0
    tab.get_by_text("Stops once both are known within 0.2 %").wait_for()
    tab.locator("#known-words", has_text=re.compile(r"known within \d\.\d %")).wait_for()
    tab.locator("#dose-used", has_text=re.compile(r"[1-9]")).wait_for()
    service.rig.speed = 0.1
    tab.locator("#least-known", has_text="140 µs").wait_for()
    with service.client() as client:
        test_id = client.get("/v1/tests").json()[0]["id"]
        box = tab.get_by_role("button", name="Enough").bounding_box()
        assert box["y"] + box["height"] < 768  # of a small laptop
        tab.get_by_role("button", name="Enough").click()
        tab.locator("#enough").wait_for(state="hidden")
        document = wait_done(client, test_id)
    assert (document["state"], document["adaptive"]["ended"]) == ("completed", "enough")
    after = tab.context.new_page()  # the running test's page goes on to the model by itself, at a moment of its own
    after.goto(f"{service.url}/tests/{test_id}")
    after.get_by_text("A person said that it is enough").wait_for()
    assert tab.errors == []
