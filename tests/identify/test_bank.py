"""A bank of models: it knows whom a muscle is like, says when it is like none, and never knows more than it should."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.experiments.adaptive import Asked, Target, decide
from stimrig.identify.experiments.bank import UNLIKE, Bank, Candidate, Weighed, rough_evidence, weigh
from stimrig.identify.experiments.designs import bursts
from stimrig.identify.experiments.knowledge import knowledge
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from tests.harness.adaptive import Muscle, Played, play, recorded, shaped, sigmoid

LIMITS: dict[str, Any] = {"left_s": 30.0, "left_nm_s": 1e3}
MUSCLE = shaped(51_010)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng([seed, 77]).standard_normal(16_000) * 0.05


def model_of(muscle: Muscle, seed: int) -> Model:
    made = play(muscle, noise(seed), Target(3.0, 3.0), **LIMITS)
    assert made.record is not None
    return identify.fit(made.record, recruitment="near-sigmoid")


@pytest.fixture(scope="module")
def models() -> dict[str, Model]:
    """The muscle of these tests on another day, and two others."""
    day = MUSCLE.another_day(np.random.default_rng(3))
    return {"own": model_of(day, 1), "second": model_of(sigmoid(51_008), 2), "third": model_of(sigmoid(51_005), 3)}


def looked_at(muscle: Muscle = MUSCLE) -> tuple[Record, np.ndarray]:
    """The record of an opening and a step, and its widths."""
    ramp = muscle.top_us * np.arange(1, 17) / 16.0
    widths = np.r_[np.zeros(20), ramp, np.zeros(44), np.full(20, 0.7 * muscle.top_us), np.zeros(20)]
    return recorded(muscle, widths, ["opening"] * widths.size, noise(9)), widths


def weights(record: Record, bank: Bank) -> dict[str, float]:
    return weigh(prepare(record)[0], bank).to_dict()


def away(made: Played, muscle: Muscle) -> bool:
    """Whether a true curve is outside its band."""
    known = made.decision.knowledge
    assert known is not None
    curve = np.abs(muscle.curve(known.curve.at) / known.plateau_nm - known.curve.value) > known.curve.half
    return bool(np.any(curve | (np.abs(muscle.step(known.step.at) - known.step.value) > known.step.half)))


@pytest.mark.slow
def test_somebody_of_the_bank_is_recognised_and_takes_half_the_dose(models: dict[str, Model]):
    new = play(MUSCLE, noise(4), Target(3.0, 3.0), **LIMITS)
    made = play(MUSCLE, noise(4), Target(3.0, 3.0), **LIMITS, bank=Bank.of(models))
    assert made.decision.kind == "enough" and not away(made, MUSCLE)
    assert made.decision.weighed is not None and made.decision.weighed.name == "own"
    assert "Like own" in made.decision.words
    assert made.decision.to_dict()["bank"]["own"] > 0.9
    assert made.dose_nm_s(MUSCLE) <= 0.5 * new.dose_nm_s(MUSCLE)


@pytest.mark.slow
def test_somebody_like_none_is_told_so_and_loses_nothing(models: dict[str, Model]):
    others = Bank.of({name: model for name, model in models.items() if name != "own"})
    new = play(MUSCLE, noise(4), Target(3.0, 3.0), **LIMITS)
    made = play(MUSCLE, noise(4), Target(3.0, 3.0), **LIMITS, bank=others)
    assert made.decision.weighed is not None and made.decision.weighed.is_unlike
    assert made.decision.kind == "enough" and not away(made, MUSCLE)
    assert made.dose_nm_s(MUSCLE) <= 1.3 * new.dose_nm_s(MUSCLE)


@pytest.mark.slow
def test_neither_the_banks_order_nor_sign_and_zero_of_the_torque_change_the_weights(models: dict[str, Model]):
    record, _ = looked_at()
    bank = Bank.of(models)
    found = weights(record, bank)
    assert max(found, key=found.__getitem__) == "own" and sum(found.values()) == pytest.approx(1.0)
    turned = replace(bank, candidates=bank.candidates[::-1])
    assert weights(record, turned) == pytest.approx(found, abs=1e-9)
    # Not exactly: searches end where they gain little.
    for torque in (-record.torque_nm, record.torque_nm + 3.0):
        assert weights(record.with_torque(torque), bank) == pytest.approx(found, abs=0.02)


@pytest.mark.slow
def test_a_doubt_between_two_is_in_the_bands(models: dict[str, Model]):
    record, _ = looked_at()
    weighed = weigh(prepare(record)[0], Bank.of({"own": models["own"]}))
    assert weighed.names == ("own", UNLIKE)
    alone = [knowledge(fit) for fit in weighed.fits]
    sure = replace(weighed, weights=np.array([1.0, 0.0])).mixed
    np.testing.assert_array_equal(sure.coefficients_nm, weighed.fits[0].coefficients_nm)
    moved = replace(weighed.fits[1], coefficients_nm=1.5 * weighed.fits[1].coefficients_nm)
    doubt = knowledge(replace(weighed, fits=(weighed.fits[0], moved), weights=np.array([0.6, 0.4])).mixed)
    assert doubt.curve.percent > max(known.curve.percent for known in alone)
    top = doubt.plateau_nm * (doubt.curve.value[-1] + np.array([-1.0, 1.0]) * doubt.curve.half[-1])
    assert top[0] < alone[0].plateau_nm and top[1] > 1.5 * alone[1].plateau_nm


@pytest.mark.slow
def test_what_was_thought_before_the_test_counts(models: dict[str, Model]):
    record, _ = looked_at()
    grid = prepare(record)[0]
    even, hardly = (weigh(grid, Bank.of(models, unlike)).to_dict() for unlike in (0.5, 1.0 - 1e-9))
    assert even[UNLIKE] < hardly[UNLIKE]
    odds = np.log(hardly[UNLIKE] / hardly["own"]) - np.log(even[UNLIKE] / even["own"])
    assert odds == pytest.approx(np.log((1.0 - 1e-9) / 1e-9), rel=1e-6)


def test_a_bank_is_the_same_after_it_was_written(models: dict[str, Model]):
    bank = Bank.of(models, 0.3)
    again = Bank.from_dict(json.loads(json.dumps(bank.to_dict())))
    assert [one.name for one in again.candidates] == list(models) and again.unlike == 0.3
    grid = prepare(looked_at()[0])[0]
    np.testing.assert_allclose(rough_evidence(grid, again.candidates), rough_evidence(grid, bank.candidates), rtol=1e-6)


def test_the_own_model_is_worth_a_whole_fit(models: dict[str, Model]):
    told = rough_evidence(prepare(looked_at()[0])[0], Bank.of(models).candidates)
    assert int(np.argmax(told)) == 0 and told[0] > told[1:].max() + 3.0


def test_a_bank_that_is_none_is_refused(models: dict[str, Model]):
    one = Candidate("one", models["own"])
    with pytest.raises(BadRequest, match="same name"):
        Bank((one, one))
    with pytest.raises(BadRequest, match="same name"):
        Bank((Candidate(UNLIKE, models["own"]),))
    with pytest.raises(BadRequest, match="no probability"):
        Bank((one,), 1.0)


def test_an_empty_bank_is_a_test_from_nothing():
    record, widths = looked_at()
    asked = Asked(Target(), largest_us=MUSCLE.top_us, **LIMITS)
    told = [decide(record, widths, replace(asked, bank=bank)) for bank in (None, Bank(()))]
    assert told[0].to_dict() == told[1].to_dict()


def test_the_first_look_keeps_to_what_is_left(models: dict[str, Model]):
    asked = Asked(Target(), left_s=30.0, left_nm_s=1e3, largest_us=MUSCLE.top_us, bank=Bank.of(models))
    opening = decide(None, [], asked)
    assert opening.kind == "next" and opening.expected_torque_time_nm_s > 0.0
    less = replace(asked, left_nm_s=0.9 * opening.expected_torque_time_nm_s)
    assert decide(None, [], less).kind == "spent"


@pytest.mark.parametrize("rate_hz", [10.0, 40.0])
def test_the_first_look_is_played_once(models: dict[str, Model], rate_hz: float):
    asked = Asked(Target(), largest_us=MUSCLE.top_us, pulse_rate_hz=rate_hz, bank=Bank.of(models), **LIMITS)
    widths = np.array(decide(None, [], asked).segments[0].settings["pulse_width_us"])
    time_s = np.arange(widths.size * 5) / (5.0 * rate_hz)
    torque = MUSCLE.curve(np.repeat(widths, 5)) + noise(8)[: time_s.size]
    record = Record.from_arrays(time_s, np.repeat(widths, 5), torque, pulse_rate_hz=rate_hz)
    assert decide(record, widths, asked).short is not None


def test_a_burst_is_followed_by_silence():
    for piece in bursts(np.array([0.0, 100.0, 200.0]), 40.0):
        assert piece.pulse_width_us.size == 40 and not piece.pulse_width_us[16:].any()
        assert piece.pulse_width_us[0] > 0.0


def test_the_words_name_whom_the_person_is_like():
    told = Weighed(("own", UNLIKE), np.array([0.9, 0.1]), (), (None, None))
    assert told.words() == "Like own (90 %)."
    assert replace(told, weights=np.array([0.2, 0.8])).words() == "Like no earlier model (80 %)."
