"""The array on a limb: what its physics promises, what a seed decides, and what an experimenter sees of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stimrig.hardware_sim.electrode_array import Seen, Session, Truth, draw_array

SEEDS = range(12)
CHARGE = 300.0, 18.0


def played(session: Session) -> list[Seen]:
    return [session.stimulate(elements, 300.0, ma) for elements in ((6,), (6, 7), (11,)) for ma in (8.0, 14.0, 20.0)]


@pytest.mark.parametrize("elements", [16, 24])
def test_a_seed_and_a_session_decide_everything(elements: int) -> None:
    first, again = draw_array(3, elements), draw_array(3, elements)
    assert first.elements == first.rows * first.columns == elements
    assert 10.0 <= first.pitch_mm <= 14.0
    assert len(first.choices) == elements + elements * (elements - 1) // 2
    seen = played(first.session(2))
    assert seen == played(first.session(2)) == played(again.session(2))
    assert seen != played(first.session(3))
    assert seen != played(draw_array(4, elements).session(2))


def test_torque_spill_and_pain_rise_with_charge_and_have_their_ranges() -> None:
    for seed in SEEDS:
        session = draw_array(seed).session(1)
        fields = [session.field(300.0, ma) for ma in (1.0, 5.0, 10.0, 20.0, 60.0)]
        for rows in zip(*fields, strict=True):
            assert np.all(np.diff(np.stack(rows), axis=0) >= 0.0)
        assert max(fields[0].pain) < 0.2
        assert 0.0 <= min(fields[0].spill) <= max(fields[-1].spill) <= 1.0
        assert max(fields[-1].torque_nm) <= session.limb.largest_nm
        assert max(fields[-1].pain) > 5.0


def test_a_pair_splits_the_current() -> None:
    """A nerve gets the mean of what either element alone does to it, and two halves hurt less than a whole."""
    for seed in SEEDS:
        session = draw_array(seed).session(1)
        limb = session.limb
        one, other, both = (session.truth(elements, *CHARGE) for elements in ((6,), (7,), (6, 7)))
        assert both.pain < max(one.pain, other.pain)
        point = replace(limb.wanted, points_mm=limb.wanted.points_mm[:1], shares=np.ones(1), branch_ma=np.inf)
        session.limb = replace(limb, wanted=replace(point, thresholds_ma=limb.wanted.thresholds_ma[:1]))
        torques_nm = [session.truth(elements, *CHARGE).torque_nm for elements in ((6,), (7,), (6, 7))]
        assert min(torques_nm[:2]) <= torques_nm[2] <= max(torques_nm[:2])


def test_far_elements_reach_less() -> None:
    for seed in SEEDS:
        array = draw_array(seed)
        session, nearest = array.session(1), array.limb.wanted.points_mm[:, :2].mean(axis=0)
        away_mm = np.linalg.norm(array.places_mm() - nearest, axis=1)
        torque_nm = session.field(*CHARGE).torque_nm[: array.elements]
        assert np.corrcoef(away_mm, torque_nm)[0, 1] < -0.2


def test_what_is_seen_is_the_truth_with_the_errors_stated() -> None:
    session = draw_array(5).session(1)
    errors: list[tuple[float, float]] = []
    spill, comfort = set(), []
    for _ in range(400):
        true = session.truth((7,), *CHARGE)
        seen = session.stimulate((7,), *CHARGE)
        errors.append((seen.torque_nm - true.torque_nm, true.torque_nm))
        spill.add(seen.spill)
        comfort.append(seen.comfort - (10.0 - true.pain))
    error, torque = np.array(errors).T
    assert abs(error.mean()) < 0.1 * torque.mean()
    assert 0.05 < error.std() < 0.08 + 0.3 * torque.mean()
    assert spill <= {0, 1, 2}
    assert abs(np.mean(comfort)) < 1.5
    assert 0.4 < np.std(comfort) < 1.2


def test_the_skin_creeps_and_another_day_is_alike() -> None:
    apart_mm, alike, others = [], [], []
    for seed in SEEDS:
        array = draw_array(seed)
        session = array.session(1)
        before = np.array(session.moved_mm)
        for _ in range(50):
            session.stimulate((1,), 100.0, 1.0)
        apart_mm.append(np.linalg.norm(np.array(session.moved_mm) - before))
        first, second, other = (
            one.session(number).field(*CHARGE).torque_nm
            for one, number in ((array, 1), (array, 2), (draw_array(seed + 50), 1))
        )
        assert not np.allclose(first, second)
        alike.append(np.corrcoef(first, second)[0, 1])
        others.append(np.corrcoef(first, other)[0, 1])
    assert 0.1 < np.mean(apart_mm) < 2.0
    assert np.mean(alike) > 0.7 > np.mean(others)


def test_the_best_choice_is_the_best_of_all_there_are() -> None:
    session = draw_array(7, 24).session(1)
    worth = lambda torque_nm, spill, pain: torque_nm / session.limb.largest_nm - spill - pain / 10.0  # noqa: E731
    currents_ma = [6.0, 10.0, 14.0, 18.0, 22.0]
    best = session.best(worth, [200.0, 300.0], currents_ma)
    values = {
        (elements, width_us, ma): worth(true.torque_nm, true.spill, true.pain)
        for elements in session.array.choices[::7]
        for width_us in (200.0, 300.0)
        for ma in currents_ma
        for true in [session.truth(elements, width_us, ma)]
    }
    assert best.utility >= max(values.values()) - 1e-12
    true = session.truth(best.elements, best.width_us, best.current_ma)
    assert best.utility == pytest.approx(worth(true.torque_nm, true.spill, true.pain))
    assert isinstance(best.truth, Truth)
    assert best.truth.torque_nm == pytest.approx(true.torque_nm)


@pytest.mark.parametrize("elements", [(), (0,), (17,), (3, 3)])
def test_elements_that_are_not_there(elements: tuple[int, ...]) -> None:
    session = draw_array(1).session(1)
    for ask in (session.stimulate, session.truth):
        with pytest.raises(ValueError, match="element"):
            ask(elements, *CHARGE)


def test_no_other_sizes_and_no_charge_of_nothing() -> None:
    with pytest.raises(ValueError, match="there are 16, 24"):
        draw_array(1, 12)
    with pytest.raises(ValueError, match="above zero"):
        draw_array(1).session(1).truth((1,), 300.0, 0.0)
