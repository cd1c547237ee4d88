"""The structure of an earlier session on a new record of the same muscle: what is still needed, and what is offered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from stimrig import identify
from stimrig.identify.conclusion import conclude
from stimrig.identify.records.record import Record
from tests.harness import few_effects
from tests.harness.carried_sessions import SESSIONS, as_record, fine_session, muscle, session
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow


def again(hidden: str) -> Record:
    """Another test of the muscle: other pulses and noise, another zero, sign and scale of the load cell."""
    made = hidden_muscles.record(hidden, seed=8)
    return made.with_torque(3.0 - 0.4 * made.torque_nm)


@pytest.fixture(scope="module")
def earlier() -> identify.Model:
    return identify.fit(hidden_muscles.record("fatigue", seed=7), effects=["fatigue"])


def test_effect_that_is_still_there_stays_in_its_form(earlier: identify.Model) -> None:
    told: list[str] = []
    record = again("fatigue")
    found = identify.carry(record, earlier, lambda _share, text: told.append(text))
    assert (found.offered, found.still_needed, found.no_longer_needed) == ("carried", ("fatigue",), ())
    assert found.model.effects[0]["form"] == earlier.effects[0]["form"]
    assert found.model.extra["parent"] == found.models[0].model_id
    assert found.models[1].fit["held_out_rms_nm"] < found.models[0].fit["held_out_rms_nm"]
    assert "still needed" in str(found) and found.carried_from == earlier.model_id
    assert any("fatigue" in text for text in told)
    with few_effects.only("fatigue", "baseline_drift"):
        assert "fatigue" in [entry["effect"] for entry in identify.diagnose(record).missing], "without it it is missing"


def test_effect_that_is_gone_is_dropped_and_the_plain_model_offered(earlier: identify.Model) -> None:
    found = identify.carry(again(""), earlier)
    assert (found.offered, found.why, found.still_needed) == ("plain", "nothing-needed", ())
    assert found.no_longer_needed == ("fatigue",) and found.model.effects == () and len(found.models) == 1


def test_effect_beside_something_else_that_is_missing_is_not_told_as_gone() -> None:
    earlier = identify.fit(hidden_muscles.record("baseline_drift", seed=7), effects=["baseline_drift"])
    found = identify.carry(again("asymmetric_relaxation"), earlier)
    assert found.offered == "plain" and found.undecided == ("baseline_drift",) and found.no_longer_needed == ()


@pytest.mark.parametrize(
    ("change", "why", "words"),
    [
        ({"effects": ({"id": "my_effect", "form": ""},)}, "not-installed", "my_effect, which is not installed here"),
        ({"effects": ()}, "plain-before", "plain structure as well"),
        ({"method": "two-stage"}, "other-method", "two-stage"),
    ],
)
def test_structure_that_cannot_be_carried_over_leaves_the_plain_model(
    earlier: identify.Model, change: dict[str, Any], why: str, words: str
) -> None:
    found = identify.carry(again("fatigue"), replace(earlier, **change))
    assert (found.offered, found.why, found.effects) == ("plain", why, ()) and words in found.reason
    assert found.model.effects == ()


def test_cancelled_when_the_caller_says_so(earlier: identify.Model) -> None:
    def stop(share: float, _text: str) -> None:
        if share > 0.5:
            raise identify.Cancelled("stop")

    with pytest.raises(identify.Cancelled):
        identify.carry(again("fatigue"), earlier, stop)


def other_counting(record: Record) -> Record:
    return replace(record.with_torque(-10.0 * record.torque_nm - 50.0), time_s=record.time_s + 12345.678)


Answer = tuple[str, set[str], set[str], set[str]]


def said(record: Record, model: identify.Model) -> Answer:
    found = identify.carry(record, model)
    return found.offered, set(found.still_needed), set(found.no_longer_needed), set(found.undecided)


def test_how_torque_and_time_are_counted_does_not_matter(earlier: identify.Model) -> None:
    assert said(other_counting(again("fatigue")), earlier) == ("carried", {"fatigue"}, set(), set())


def holding(*effects: tuple[str, str]) -> identify.Model:
    """A model of these effects and forms; its numbers are never used."""
    plain = identify.fit(hidden_muscles.record("", seed=7))
    return replace(plain, effects=tuple({"id": name, "form": form} for name, form in effects))


@pytest.mark.campaign
def test_neither_the_order_of_the_effects_nor_the_counting_matters_to_a_weak_and_a_strong_one() -> None:
    """The weak one, fitted alone, took what belongs to the strong one; and the best of both was never found."""
    weak, strong = ("recruitment_hysteresis", "two_curves"), ("fatigue", "fitness")
    fine = fine_session(muscle(5133), 5133, "third")  # a third effect, too, that the earlier model does not have
    record = as_record({name: column[::8] for name, column in fine.items()})  # at 200 Hz
    wanted = said(record, holding(weak, strong))
    assert said(record, holding(strong, weak)) == wanted
    for changed in (other_counting(record), record.with_torque(0.1 * record.torque_nm + 37.0)):
        assert said(changed, holding(weak, strong)) == wanted


def test_a_third_effect_is_named_beside_the_structure_and_one_that_is_not_named_is_said_to_be_open() -> None:
    record = session(muscle(5006), 5006, "third", SESSIONS["third"])
    found = identify.carry(record, holding(("fatigue", "fitness"), ("asymmetric_relaxation", "slow_lag")))
    assert found.still_needed == ("fatigue", "asymmetric_relaxation")
    with few_effects.only(*found.still_needed, "output_saturation", "threshold_drift"):
        told = identify.diagnose(record, found.model)
    assert [entry["effect"] for entry in told.missing] == ["output_saturation"]
    untold = replace(told, verdict="nothing_missing", missing=(), probability=0.2)
    assert "log evidence would rise by" in str(untold) and "cannot tell" in str(untold)
    assert conclude(untold.to_dict()).kind == "unsure" == untold.to_dict()["conclusion"]["kind"]
