"""Muscles of other physics are physical, and are no static curve before linear dynamics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bench.muscles.mechanism import DRIVEN_BY, ENTERS
from bench.muscles.other_physics import (
    SETS,
    PhysicsMuscle,
    draw_muscle,
)
from bench.muscles.physics_records import record_of_physics
from stimrig.hardware_sim.hidden.chain import Chain

RATE_HZ, HELD = 1600, 40
"""Steps a second, and those of a pulse's period."""
DRAWN = [(kinds, name) for kinds in SETS for name in SETS[kinds]]

Answer = Callable[[np.ndarray], np.ndarray]


def drawn(kinds: str, name: str, round_: int = 0) -> PhysicsMuscle:
    return draw_muscle(kinds, list(SETS[kinds]).index(name) + round_ * len(SETS[kinds]))


def answer_of(muscle: PhysicsMuscle) -> Answer:
    """Torque of the rested muscle at 1600 Hz to widths at 40 pulses/s."""

    def answer(widths_us: np.ndarray) -> np.ndarray:
        chain = Chain(muscle.stages(), muscle.base.largest_nm, 1.0 / RATE_HZ)
        held, still = np.repeat(widths_us, HELD), np.zeros(widths_us.size * HELD)
        pulse = still.copy()
        pulse[::HELD] = widths_us > 0.0
        return chain.run(held, pulse, still, still)

    return answer


def departure(muscle: PhysicsMuscle) -> float:
    """How far the muscle is from every static curve before linear dynamics, over its largest torque.

    Of those the answer to two trains is the sum of the answers to each, and another width gives the same shape.
    """
    answer, top_us = answer_of(muscle), muscle.base.largest_width_us
    first, second = np.zeros(200), np.zeros(200)
    first[:60], second[60:120] = top_us, top_us
    alone, both = answer(first), answer(first + second)
    apart = np.max(np.abs(both - alone - answer(second)))
    weaker = answer(np.where(first > 0.0, muscle.base.rise_us()[0] + 0.4 * np.ptp(muscle.base.rise_us()), 0.0))
    share = weaker @ alone / (alone @ alone)
    return max(apart, np.max(np.abs(weaker - share * alone))) / np.max(both)


@pytest.mark.parametrize("round_", range(4))
@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_a_muscle_rests_rises_and_decays(kinds: str, name: str, round_: int) -> None:
    muscle = drawn(kinds, name, round_)
    answer, rest, train = answer_of(muscle), np.zeros(80), np.full(120, float(muscle.base.largest_width_us))
    torque = answer(np.concatenate([rest, train, np.zeros(600)]))
    assert not torque[: 80 * HELD].any()
    assert 1.79 < np.max(torque) < 9.01
    assert np.argmax(torque) < 205 * HELD
    assert np.max(np.abs(torque[-10 * HELD :])) < 0.2 * np.max(torque)
    assert not answer(rest).any()


@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_any_widths_are_borne(kinds: str, name: str) -> None:
    rng = np.random.default_rng(1)
    widths_us = np.concatenate(
        [rng.choice([0.0, 1.0, 4095.0, 26000.0, *rng.uniform(0.0, 511.0, 8)], 800), np.zeros(80)]
    )
    muscle = drawn(kinds, name)
    torque = answer_of(muscle)(widths_us)
    assert np.isfinite(torque).all()
    assert np.max(np.abs(torque)) < 20.0
    assert np.abs(torque[-1]) < 0.25 * np.max(torque)
    assert np.array_equal(torque, answer_of(drawn(kinds, name))(widths_us))


@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_no_muscle_is_a_static_curve_before_linear_dynamics(kinds: str, name: str) -> None:
    assert np.median([departure(drawn(kinds, name, round_)) for round_ in range(16)]) > 0.05


def test_the_oracle_sees_nothing_in_a_plain_muscle() -> None:
    assert max(departure(draw_muscle("plain", seed)) for seed in range(4)) < 1e-3


@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_right_answers_are_few_words_of_the_vocabulary(kinds: str, name: str) -> None:
    truth = record_of_physics(kinds, list(SETS[kinds]).index(name))["truth"]
    assert truth["kind"] == name
    assert 1 <= len(truth["enters"]) <= 3 and set(truth["enters"]) <= set(ENTERS)
    assert 1 <= len(truth["driven_by"]) <= 3 and set(truth["driven_by"]) <= set(DRIVEN_BY)
