"""Following a test that stops itself, without a rig and without time: when it asks and answers, what goes wrong."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from typing import Any

import pytest

from stimrig.api.sessions import adaptive_follower, kinds
from stimrig.api.sessions.adaptive_follower import Follower
from stimrig.rig.messages import AHEAD, AdaptivePlan, LaidSegment, LatePulse, LiveEvent, Profile, SegmentPlan, TestPlan
from stimrig.rig.requests import ExtendRequest

FIRST_S = 3.0
NEXT = {"name": "hold 2", "sequence": "widths", "settings": {"pulse_width_us": [100.0] * 10, "jumps": True}}
SAID: dict[str, Any] = {
    "kind": "next", "segments": [NEXT], "words": "Known a little.", "expected_torque_time_nm_s": 1.0,
    "knowledge": None, "least_known": None,
}  # fmt: skip


class World:
    """Clock, rig and adviser in one: the time is that of the newest event."""

    def __init__(self, answers: list[Any]) -> None:
        self.now_s, self.answers = 0.0, answers
        self.requests: list[tuple[float, Any]] = []
        self.asked: list[dict[str, Any]] = []

    def monotonic_s(self) -> float:
        return self.now_s

    async def ask(self, what: Any, **arguments: Any) -> Any:
        """A question to the adviser is a text; None of the answers never comes."""
        if what == "adaptive_begin":
            return {}
        if not isinstance(what, str):
            self.requests.append((self.now_s, what))
            return {}
        self.asked.append(arguments)
        if (answer := self.answers.pop(0) if self.answers else None) is None:
            await asyncio.Event().wait()
        return answer

    async def events(self, _path: object, test_id: str) -> AsyncGenerator[LiveEvent, None]:
        while self.now_s < FIRST_S:
            self.now_s += 0.02
            yield LiveEvent(
                test_id=test_id, segment="opening", elapsed_s=self.now_s, duration_s=45.0, time_s=[],
                torque_min_nm=[], torque_max_nm=[], pulse_time_s=[], pulse_width_us=[], torque_age_s=0.0,
                lost_samples=0, dropped_pulses=0, sent_pulses=0, charge_uc=0.0, torque_time_nms=0.0, ended_by="",
                samples=None, laid=30, boundary_s=FIRST_S, not_sent=[4], late=[LatePulse(index=2, by_s=0.01)],
                laid_segments=[LaidSegment(name="opening", start_s=0.0, end_s=FIRST_S, by="plan")],
            )  # fmt: skip
            for _ in range(5):
                await asyncio.sleep(0)


def followed(world: World, rate_hz: float, monkeypatch: pytest.MonkeyPatch) -> Follower:
    monkeypatch.setattr(kinds, "samples_of", world.events)
    opening = SegmentPlan(name="opening", sequence="widths", settings={"pulse_width_us": [0.0] * round(3 * rate_hz)})
    plan = TestPlan(
        test_id="T1", participant="P017",
        profile=Profile(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0),
        segments=[opening], pulse_rate_hz=rate_hz,
        adaptive=AdaptivePlan(max_duration_s=45.0, max_torque_time_nms=360.0),
    )  # fmt: skip
    whole: Any = world
    target = {"curve_percent": 2.0, "step_percent": 2.0}
    follower = Follower(plan, {"target": target}, {}, whole, whole, whole, lambda: None)
    asyncio.run(follower.run(None))
    return follower


@pytest.mark.parametrize("rate_hz", [10.0, 40.0])
def test_the_early_answer_is_sent_before_the_rig_decides(monkeypatch: pytest.MonkeyPatch, rate_hz: float) -> None:
    world = World([SAID])
    follower = followed(world, rate_hz, monkeypatch)
    [(at_s, request)] = world.requests
    assert isinstance(request, ExtendRequest) and request.after == 30
    decided_s = FIRST_S - AHEAD / rate_hz
    assert decided_s - adaptive_follower.SEND_S - 0.03 < at_s < decided_s
    assert follower.told.problem == ""


def test_the_newest_answer_is_sent_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    newer = {**SAID, "segments": [{**NEXT, "name": "ramp 2"}]}
    world = World([SAID, newer])
    followed(world, 40.0, monkeypatch)
    [(at_s, request)] = world.requests
    assert request.segments[0].name == "ramp 2"
    assert at_s == pytest.approx(FIRST_S - AHEAD / 40.0 - adaptive_follower.LATE_S, abs=0.03)


def test_the_adviser_learns_what_the_muscle_felt(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World([SAID])
    followed(world, 40.0, monkeypatch)
    assert (world.asked[0]["not_sent"], world.asked[0]["late"]) == ([4], [(2, 0.01)])


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ({**SAID, "segments": [{**NEXT, "settings": {}}]}, "KeyError"),
        ({**SAID, "kind": "misfit", "segments": []}, "Known a little."),
        ({}, "KeyError"),
    ],
)
def test_an_answer_that_cannot_be_used_is_told(
    monkeypatch: pytest.MonkeyPatch, answer: dict[str, Any], why: str
) -> None:
    world = World([answer])
    told = followed(world, 40.0, monkeypatch).told
    assert told.state == "fixed" and told.problem.startswith("The fixed plan plays on: ") and why in told.problem
    assert world.requests == []
