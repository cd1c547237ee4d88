"""What must not change what is said of a carried structure; and what is said where the record leaves it open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest

from stimrig import identify
from stimrig.api.models.explanation import headline
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import SESSIONS, as_record, fine_session, muscle, session
from tests.identify import hidden_muscles

Answer = tuple[str, set[str], set[str], set[str]]


@cache
def plain() -> identify.Model:
    return identify.fit(hidden_muscles.record("", seed=7))


def earlier(*effects: tuple[str, str]) -> identify.Model:
    """A model of these effects and forms; its numbers are never used."""
    return replace(plain(), effects=tuple({"id": name, "form": form} for name, form in effects))


WEAK, STRONG = ("recruitment_hysteresis", "difference"), ("fatigue", "compartments")


@cache
def second_session() -> Record:
    """Both effects, and a third that the earlier model does not have."""
    fine = fine_session(muscle(5133), 5133, "third")
    return as_record({name: column[::8] for name, column in fine.items()})  # at 200 Hz


def said(record: Record, *effects: tuple[str, str]) -> Answer:
    found = identify.carry(record, earlier(*effects))
    return found.offered, set(found.still_needed), set(found.no_longer_needed), set(found.undecided)


@cache
def unchanged() -> Answer:
    return said(second_session(), WEAK, STRONG)


def test_the_order_of_the_effects_in_the_earlier_model_does_not_matter() -> None:
    """The weak one, fitted alone, took what belongs to the strong one; and the best of both was never found."""
    assert unchanged() == said(second_session(), STRONG, WEAK)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: replace(r.with_torque(-10.0 * r.torque_nm - 50.0), time_s=r.time_s + 12345.678),
        lambda r: r.with_torque(0.1 * r.torque_nm + 37.0),
    ],
)
def test_nor_does_it_how_torque_and_time_are_counted(change: Callable[[Record], Record]) -> None:
    assert said(change(second_session()), WEAK, STRONG) == unchanged()


@pytest.mark.slow
def test_a_third_effect_that_is_too_weak_to_be_named_beside_the_structure_is_said_to_be_open() -> None:
    of = muscle(5006)
    record = session(of, 5006, "third", SESSIONS["third"])
    found = identify.carry(record, earlier(("fatigue", "fitness"), ("asymmetric_relaxation", "slow_lag")))
    assert found.still_needed == ("fatigue", "asymmetric_relaxation")
    told = identify.diagnose(record, found.model)
    assert told.missing == () and told.probability < 0.5
    assert "output_saturation: log evidence would rise by" in str(told) and "cannot tell" in str(told)
    assert not any("nothing is missing" in line.lower() for line in told.plain)
    title = headline(told.to_dict(), [], None, found.still_needed)
    assert title["kind"] == "unsure" and "explains too little to be named" in title["words"]
