"""An adaptive test of two muscles: it stops when both are known, keeps to the dose of each, and takes no side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stimrig.identify.errors import BadRequest
from stimrig.identify.experiments.knowledge import Target
from stimrig.identify.muscles import JointRecord
from stimrig.identify.muscles.adaptive import Asked, decide, fitted
from stimrig.identify.muscles.foresight import Foresight
from stimrig.identify.muscles.pieces import Piece, Pieces
from stimrig.rig.messages import SegmentPlan
from stimrig.rig.sequences import build
from tests.harness.adaptive_several import CHANNELS, EXTENSOR, FLEXOR, THIRD, Joint, Played, dose_nm_s, play, recorded
from tests.harness.two_muscles import LARGEST_US, NAMES, PULSES_HZ

JOINT = FLEXOR, EXTENSOR
ASKED = Asked(NAMES, Target(2.0, 2.0), 40.0, (200.0, 200.0), (2e5, 2e5), (LARGEST_US,) * 2, (9.0, 7.0))


@pytest.fixture(scope="module")
def whole() -> Played:
    return play(JOINT, ASKED)


@pytest.fixture(scope="module")
def foresight(whole: Played) -> Foresight:
    """After the opening."""
    return Foresight(fitted(recorded(JOINT, whole.widths_us[:300])))


def test_it_stops_when_both_muscles_are_known(whole):
    assert whole.last.kind == "enough" and len(whole.widths_us) < 0.75 * ASKED.most_s * PULSES_HZ
    for known in whole.last.knowledge:
        assert known.curve.percent <= 2.0 and known.step.percent <= 2.0
    first = next(one for one in whole.decisions if one.knowledge)
    assert max(known.curve.percent for known in first.knowledge) > 2.0


def covered(joint: Joint, made: Played) -> bool:
    """Whether the bands at the end hold each true curve as a whole."""
    for muscle, known in zip(joint, made.last.knowledge, strict=True):
        away = np.abs(np.abs(muscle.curve_nm(known.curve.at)) / known.plateau_nm - known.curve.value)
        if np.any(away > known.curve.half):
            return False
    return True


def test_the_bands_hold_the_true_curves(whole):
    assert covered(JOINT, whole)


@pytest.mark.slow
def test_three_muscles_are_known_in_one_test():
    joint = *JOINT, THIRD
    more = {"most_nm_s": (200.0,) * 3, "most_us": (2e5,) * 3, "largest_us": (LARGEST_US,) * 3}
    made = play(joint, replace(ASKED, names=CHANNELS, largest_nm=(9.0, 7.0, 6.0), **more))
    assert made.last.kind == "enough" and covered(joint, made)


@pytest.mark.slow
@pytest.mark.parametrize(("place", "bound"), [(0, "most_nm_s"), (1, "most_us")])
def test_no_channel_gets_more_than_its_dose(whole, place, bound):
    """A third of what the test would take of that channel after its opening; the other one is not held back by it."""
    opening = whole.decisions[0].piece.pulse_width_us
    taken = {
        "most_nm_s": lambda widths: dose_nm_s(JOINT, widths),
        "most_us": lambda widths: widths.sum(axis=0),
    }[bound]
    most = list(getattr(ASKED, bound))
    most[place] = float(max(taken(opening)[place], 0.0) + 0.3 * (taken(whole.widths_us) - taken(opening))[place])
    if bound == "most_nm_s":  # of the opening nothing is known but the largest torque
        most[place] = max(most[place], whole.decisions[0].dose_nm_s[place] + 0.1)
    asked = replace(ASKED, target=Target(0.5, 0.5), most_s=25.0, **{bound: tuple(most)})
    made = play(JOINT, asked)
    assert made.last.kind == "spent" and len(made.decisions) > 2
    assert np.all(taken(made.widths_us) <= getattr(asked, bound))
    other = 1 - place
    assert taken(made.widths_us)[other] > 2.0 * taken(opening)[other]


def test_a_dose_is_told_at_most_and_not_far_from_it(whole):
    true = dose_nm_s(JOINT, whole.widths_us)
    told = np.array(whole.last.dose_nm_s)
    assert np.all(true <= told) and np.all(told <= 1.6 * true)


def test_nothing_is_played_that_the_doses_do_not_allow():
    for tight in ({"most_s": 3.0}, {"most_nm_s": (1.0, 200.0)}, {"most_us": (2e5, 100.0)}):
        assert decide(None, np.zeros((0, 2)), replace(ASKED, **tight)).kind == "spent"


def test_a_record_that_no_pulse_moves_is_a_misfit():
    widths = np.zeros((300, 2))
    assert decide(recorded(JOINT, widths), widths, ASKED).kind == "misfit"


@pytest.mark.slow
def test_pieces_at_random_take_longer(whole, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(Foresight, "after", lambda _self, pieces, _target: (2.0, rng.uniform(0.01, 1.0, len(pieces))))
    assert len(play(JOINT, ASKED).widths_us) > 1.5 * len(whole.widths_us)


def test_a_piece_of_one_muscle_teaches_of_that_one(foresight):
    quiet = np.zeros(80)
    stairs = np.repeat([90.0, 130.0, 170.0, 210.0], 20)
    pieces = [Piece("a", np.c_[stairs, quiet]), Piece("b", np.c_[quiet, stairs]), Piece("rest", np.c_[quiet, quiet])]
    now, after = foresight.after(pieces, Target())
    doses = foresight.doses(pieces)
    assert after[2] > 0.98 * now and np.all(after[:2] < after[2])
    assert doses[0, 0] > 5.0 * doses[0, 1] and doses[1, 1] > 5.0 * doses[1, 0]
    assert np.all(doses[2] < 0.02 * doses[:2].max())


def test_what_a_piece_teaches_is_what_the_longer_record_shows(whole):
    """The linearised covariance against a fit that has played the piece: within a factor, of a curve's widest place."""
    begun = whole.widths_us[:300]
    before = Foresight(fitted(recorded(JOINT, begun)))
    piece = Piece("stairs", np.c_[np.repeat([90.0, 130.0, 170.0, 210.0], 20), np.zeros(80)])
    now, after = before.after([piece], Target())
    later = Foresight(fitted(recorded(JOINT, np.concatenate([begun, piece.pulse_width_us]))))
    then, _ = later.after([piece], Target())
    assert after[0] < now
    assert 0.4 < then / after[0] < 2.5


def _swapped(joint: Joint) -> Joint:
    return joint[1], joint[0]


def test_swapped_channels_swap_what_is_known(whole):
    """The offset between the channels stays with the second one: the record differs by it alone."""
    widths = whole.widths_us[:500]
    ahead = Foresight(fitted(recorded(JOINT, widths, noise_nm=0.02))).knowledge
    turned = Foresight(fitted(recorded(_swapped(JOINT), widths[:, ::-1], noise_nm=0.02))).knowledge
    for one, other in zip(ahead, turned[::-1], strict=True):
        assert one.plateau_nm == pytest.approx(other.plateau_nm, rel=0.02)
        np.testing.assert_allclose(one.curve.value, other.curve.value, atol=one.curve.percent / 100.0 + 0.01)


@pytest.mark.parametrize("factor", [0.1, 10.0, -1.0])
def test_scale_and_sign_of_the_torque_change_no_choice(whole, factor):
    """In other units, or a sensor that is turned round, the same piece is chosen and the same share is known."""
    widths = whole.widths_us[:300]
    record = recorded(JOINT, widths)
    other = JointRecord(record.channels, record.with_torque(factor * record.torque_nm).records)
    doses = tuple(abs(factor) * most for most in ASKED.most_nm_s)
    first, second = decide(record, widths, ASKED), decide(other, widths, replace(ASKED, most_nm_s=doses))
    assert first.piece is not None and second.piece is not None and first.piece.kind == second.piece.kind
    np.testing.assert_allclose(first.piece.pulse_width_us, second.piece.pulse_width_us, atol=0.2)
    np.testing.assert_allclose(np.array(first.dose_nm_s) * abs(factor), second.dose_nm_s, rtol=1e-2)
    for one, two in zip(first.knowledge, second.knowledge, strict=True):
        assert one.curve.percent == pytest.approx(two.curve.percent, rel=0.02)


def test_the_rig_plays_every_piece_as_it_was_weighed():
    made = Pieces([np.array([60.04, 137.77, 300.0]), np.array([90.0, 250.0])], PULSES_HZ, 3)
    for number, piece in enumerate([made.opening(), *made.candidates()]):
        segment = piece.segment(number, NAMES)
        assert set(SegmentPlan.model_validate(segment).channels or {}) == set(NAMES)
        for name, own in zip(NAMES, piece.pulse_width_us.T, strict=True):
            told = segment["channels"][name]
            np.testing.assert_allclose(build(told["sequence"], told["settings"], PULSES_HZ), own, atol=0.05)
        assert piece.pulse_width_us.min() >= 0.0 and np.all(piece.pulse_width_us.max(axis=0) <= (300.0, 250.0))
        assert len(piece.pulse_width_us) / PULSES_HZ <= 8.0


@pytest.mark.parametrize("wrong", [{"most_s": 0.0}, {"most_us": (1.0,)}, {"largest_nm": (1.0, float("nan"))}])
def test_numbers_that_are_none_are_refused(wrong):
    with pytest.raises(BadRequest):
        replace(ASKED, **wrong)
