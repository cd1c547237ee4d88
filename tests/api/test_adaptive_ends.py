"""Why an adaptive test ended, and how its recording is fitted, by what the rig says."""

from __future__ import annotations

from typing import Any

import pytest

from api.sessions.adaptive_tests import AdaptiveTests
from api.store.tables import Test
from rig.messages import FinishedEvent


class Nobody:
    """Participants without models, and a store without tests."""

    def all_approved_ones(self, _participant: str) -> list[Any]:
        return []

    @property
    def store(self) -> Nobody:
        return self

    def all(self, *_: Any) -> list[Any]:
        return []


@pytest.fixture
def adaptive() -> AdaptiveTests:
    nothing: Any = None
    models: Any = Nobody()
    return AdaptiveTests(nothing, nothing, models, nothing, lambda _message: None)


def row(max_duration_s: float = 45.0, planned: tuple[str, ...] = ("opening", "prbs", "validate")) -> Test:
    bounds = {"max_duration_s": max_duration_s, "max_torque_time_nms": 360.0}
    segments = [{"name": name, "start_s": 0.0, "end_s": 1.0} for name in planned]
    plan = {"adaptive": bounds, "target": {}, "reach": None, "preview": {"segments": segments}}
    return Test(id="T1", participant="P017", kind="adaptive", state="running", plan=plan, summary={})


@pytest.mark.parametrize(
    ("by", "duration_s", "ended"),
    [("plan", 42.0, "fixed-rest"), ("torque_time", 9.0, "torque-time"), ("limit", 44.4, "time"),
     ("limit", 20.0, "limit"), ("enough", 9.0, "enough"), ("stopped", 9.0, "stopped")],
)  # fmt: skip
def test_the_end_is_told_by_its_cause(adaptive: AdaptiveTests, by: str, duration_s: float, ended: str) -> None:
    summary = {"ended_by": by, "duration_s": duration_s, "torque_time_nms": 8.0}
    event = FinishedEvent(test_id="T1", outcome="completed", last_sample_unix_s=None, summary=summary)
    told = adaptive.outcome(row(), event)["adaptive"]
    assert (told["ended"], told["torque_time_nm_s"], told["state"]) == (ended, 8.0, "ended")


@pytest.mark.parametrize(
    ("ended", "planned", "helped"),
    [("known-enough", ("opening", "validate"), True), ("fixed-rest", ("opening", "prbs", "validate"), False),
     ("fixed-rest", ("opening", "prbs"), True)],
)  # fmt: skip
def test_only_a_whole_fixed_test_is_fitted_like_one(
    adaptive: AdaptiveTests, ended: str, planned: tuple[str, ...], helped: bool
) -> None:
    test = row(planned=planned)
    test.summary = {"adaptive": {"ended": ended}}
    assert bool(adaptive.fit_options(test)) == helped
