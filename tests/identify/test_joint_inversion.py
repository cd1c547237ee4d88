"""Widths of several channels for a torque of the joint: against independent muscles, limits, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig.identify import muscles
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import BadRequest, IdentifyError
from stimrig.identify.inversion import Reference
from stimrig.identify.model import Model
from stimrig.identify.muscles import Channel, JointModel, Limits, invert
from stimrig.identify.muscles.inversion import JointInversion
from stimrig.identify.muscles.model import KIND
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SigmoidBasis
from tests.harness.muscle import FINE_HZ, Patient, second_order

LARGEST_NM = {"biceps": 6.9, "triceps": 4.5}
SLOPE, MIDDLE = 0.041, {"biceps": 2389.7, "triceps": 900.0}
PERIOD_S = {"biceps": 0.16, "triceps": 0.22}
OFFSET_S = 0.0125


def muscle(name: str, sign: float) -> Model:
    curve = Curve(SigmoidBasis(SLOPE, MIDDLE[name]), np.array([sign * LARGEST_NM[name]]))
    linear = SecondOrder(PERIOD_S[name], 0.8)
    settings = {KIND: {"scale_nm": LARGEST_NM[name], "sign": sign}}
    return Model("maximum-likelihood", curve, linear, 40.0, 40.0, extra=settings)


def joint(*interplay: dict[str, Any], flexor: float = 1.0, antagonist: float = -1.0) -> JointModel:
    channels = Channel("biceps"), Channel("triceps", offset_s=OFFSET_S)
    return JointModel(channels, (muscle("biceps", flexor), muscle("triceps", flexor * antagonist)), interplay)


CROSS_TALK = {
    "id": "cross_talk", "from": "biceps", "to": "triceps", "form": "independent",
    "parameters": {"share": {"value": 0.2}, "threshold": {"value": 0.3}},
}  # fmt: skip
STIFFER = {
    "id": "co_contraction", "form": "yielding",
    "parameters": {"stiffer_up": {"value": 0.12}, "stiffer_down": {"value": 0.12}},
}  # fmt: skip


def moves() -> np.ndarray:
    """A slow sine, then to -40 % of the triceps and to half of the biceps; with minimum jerk; N·m."""
    s = np.linspace(0.0, 1.0, 70)
    up, level, parts = 10 * s**3 - 15 * s**4 + 6 * s**5, 0.0, [np.zeros(10)]
    parts.append(np.sin(2 * np.pi * np.arange(240) / 160))
    for target in (-0.4 * LARGEST_NM["triceps"], 0.5 * LARGEST_NM["biceps"], 0.0):
        parts += [level + (target - level) * up, np.full(20, target)]
        level = target
    return np.concatenate([*parts, np.zeros(20)])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def played(found: JointInversion, flexor: float = 1.0) -> np.ndarray:
    """What two muscles that know nothing of the library give, mean in each period, N·m."""
    each, whole = FINE_HZ // 40, 0.0
    for name, sign in (("biceps", 1.0), ("triceps", -1.0)):
        patient = Patient(LARGEST_NM[name], SLOPE, MIDDLE[name], PERIOD_S[name], 0.8)
        late = round(OFFSET_S * FINE_HZ) * (name == "triceps")
        active = np.repeat(patient.recruitment(found.pulse_width_us[name]), each)
        active = np.r_[np.zeros(late), active][: active.size]
        whole = whole + sign * flexor * second_order(active, PERIOD_S[name], 0.8, FINE_HZ)
    return np.asarray(whole).reshape(-1, each).mean(axis=1)


def level_of(found: JointInversion) -> dict[str, np.ndarray]:
    """Each muscle's torque as a share of its largest."""
    return {name: np.abs(own) / LARGEST_NM[name] for name, own in found.muscle_nm.items()}


@pytest.mark.parametrize("co_contraction", ["none", "constant", "stiffness"])
def test_other_muscles_follow_a_reference_across_zero(co_contraction: str) -> None:
    wanted = moves()
    found = invert(joint(), wanted, co_contraction=co_contraction)
    assert wanted.min() < -1.5 and wanted.max() > 3.0
    np.testing.assert_allclose(found.predicted_nm, played(found), atol=0.06)
    assert rms(played(found) - wanted) < 0.01 * np.ptp(wanted)
    assert found.whole_fit_percent is not None and found.whole_fit_percent > 98.0
    assert all(one.shortfall_nm < 0.1 for one in found.unreachable)


@pytest.mark.parametrize("interplay", [(CROSS_TALK,), (STIFFER,), (CROSS_TALK, STIFFER)])
@pytest.mark.parametrize("co_contraction", ["none", "constant", "stiffness"])
def test_what_the_muscles_do_to_each_other_is_corrected(interplay: tuple[Any, ...], co_contraction: str) -> None:
    wanted, told = moves(), {"co_contraction": co_contraction, "level": 0.2}
    found, naive = invert(joint(*interplay), wanted, **told), invert(joint(), wanted, **told)
    assert rms(found.predicted_nm - wanted) < 0.01 * np.ptp(wanted)
    changed = [found.pulse_width_us[name] - naive.pulse_width_us[name] for name in LARGEST_NM]
    assert max(np.abs(one).max() for one in changed) >= 2.0, "else there was nothing to correct"


def test_none_uses_one_muscle_for_each_torque() -> None:
    wanted = moves()
    found = invert(joint(), wanted)
    own = level_of(found)
    for name, silent in (("triceps", wanted > 1.0), ("biceps", wanted < -1.0)):
        assert own[name][silent].max() < 0.05 and np.median(own[name][silent]) < 1e-3, "it relaxes, and is gone"
    assert all(one[-20:].max() < 0.01 for one in own.values()), "nothing while the joint rests"


def test_the_change_at_zero_is_smooth() -> None:
    found = invert(joint(), moves(), whole=False)
    for name, own in level_of(found).items():
        assert np.abs(np.diff(own, 2)).max() < 0.01, name


def test_constant_co_contraction_holds_both() -> None:
    wanted, level = moves(), 0.2
    found = invert(joint(), wanted, co_contraction="constant", level=level)
    active = slice(40, 480)
    for name, own in level_of(found).items():
        assert own[active].min() > 0.93 * level, name
        assert level_of(invert(joint(), wanted))[name][active].min() < 0.02, name


def test_stiffness_keeps_the_smaller_muscle_active_near_zero_alone() -> None:
    wanted, level, bound_nm = moves(), 0.15, 0.6
    kept = {"level": level, "bound_nm": bound_nm}
    found = invert(joint(), wanted, co_contraction="stiffness", **kept)
    smaller = np.minimum(*level_of(found).values())
    inside = np.flatnonzero(np.abs(wanted[40:480]) < bound_nm) + 40
    assert inside.size > 40 and smaller[inside].min() > 0.8 * level
    assert np.median(smaller[inside]) < 1.1 * level, "not more than is asked for"
    assert smaller[np.abs(wanted) > 3.0].max() < 0.1 * level
    constant = invert(joint(), wanted, co_contraction="constant", level=level)
    used, more = (sum(one.sum() for one in each.pulse_width_us.values()) for each in (found, constant))
    assert used < 0.95 * more


@pytest.mark.parametrize("co_contraction", ["none", "constant"])
def test_the_limits_of_each_channel_are_kept(co_contraction: str) -> None:
    wanted = 1.1 * moves()
    limits = {
        "biceps": Limits(largest_us=190.5, rise_us=40.0, shortest_us=20.0),
        "triceps": Limits(largest_us=150.0, rise_us=25.0, dose_us=20_000.0),
    }
    free = invert(joint(), wanted, co_contraction=co_contraction).pulse_width_us
    found = invert(joint(), wanted, co_contraction=co_contraction, limits=limits).pulse_width_us
    for name, limit in limits.items():
        own = found[name]
        assert own.max() > 0.0 and np.all(own == np.round(own)) and np.all((own == 0.0) | (own >= limit.shortest_us))
        assert own.max() <= (limit.largest_us or np.inf) and own.sum() <= limit.dose_us
        assert np.diff(np.r_[0.0, own]).max() <= (limit.rise_us or np.inf)
        assert np.diff(np.r_[0.0, free[name]]).max() > (limit.rise_us or 0.0), "without limits it would not be so"
    assert free["triceps"].sum() > 20_000.0


def test_one_limit_holds_for_all_channels() -> None:
    found = invert(joint(), moves(), limits=Limits(largest_us=140.0))
    assert all(own.max() <= 140.0 for own in found.pulse_width_us.values())


@pytest.mark.parametrize("flexor", [1.0, -1.0])
def test_what_is_out_of_reach_is_told(flexor: float) -> None:
    wanted = flexor * 2.2 * moves()
    found = invert(joint(flexor=flexor), wanted)
    told = {one.reason for one in found.unreachable if one.shortfall_nm > 0.5}
    assert told == {"above-plateau"}
    for one in found.unreachable:
        if one.reason == "above-plateau":
            part = flexor * wanted[round(one.begin_s * 40) : round(one.end_s * 40)]
            assert part.max() > LARGEST_NM["biceps"] or part.min() < -LARGEST_NM["triceps"] * 0.9


def test_a_dose_that_bounds_is_told() -> None:
    limits = {"triceps": Limits(dose_us=10_000.0)}
    found = invert(joint(), moves(), limits=limits)
    assert {one.reason for one in found.unreachable} == {"beyond-dose"}
    assert found.pulse_width_us["triceps"].sum() > 9_000.0


@pytest.mark.parametrize("co_contraction", ["none", "constant", "stiffness"])
def test_order_of_channels_and_sign_of_the_record_change_nothing(co_contraction: str) -> None:
    wanted, model = moves(), joint(CROSS_TALK, STIFFER)
    first = invert(model, wanted, co_contraction=co_contraction)
    channels = [replace(one, offset_s=one.offset_s - OFFSET_S) for one in model.channels[::-1]]
    turned = model.with_(channels=tuple(channels), models=model.models[::-1])
    other = invert(turned, wanted, co_contraction=co_contraction)
    upside_down = invert(joint(CROSS_TALK, STIFFER, flexor=-1.0), -wanted, co_contraction=co_contraction)
    assert list(other.pulse_width_us) == ["triceps", "biceps"]
    for name, own in first.pulse_width_us.items():
        # the slots begin with the first channel's: what a pulse does within its period is reckoned from there
        np.testing.assert_allclose(other.pulse_width_us[name], own, atol=4.0)
        np.testing.assert_allclose(upside_down.pulse_width_us[name], own, atol=1.0)


def test_synergists_share_what_they_can_give() -> None:
    wanted = np.abs(moves()) * 2.0
    found = invert(joint(antagonist=1.0), wanted)
    assert found.whole_fit_percent is not None and found.whole_fit_percent > 90.0
    own = level_of(found)
    np.testing.assert_allclose(own["biceps"], own["triceps"], atol=0.08)
    down = invert(joint(antagonist=1.0), moves())
    assert "below-zero" in {one.reason for one in down.unreachable}
    with pytest.raises(BadRequest, match="all muscles of the model pull in one direction"):
        invert(joint(antagonist=1.0), wanted, co_contraction="constant")


@pytest.mark.parametrize(
    ("told", "place"),
    [
        ({"torque_nm": np.r_[0.0, np.nan]}, "reference_torque_nm[1]"),
        ({"torque_nm": Reference.of(np.zeros(9), pulse_rate_hz=20.0)}, "pulse_rate_hz"),
        ({"co_contraction": "much"}, "co_contraction"),
        ({"level": np.nan}, "level"),
        ({"level": 0.6}, "level"),
        ({"bound_nm": np.nan}, "bound_nm"),
        ({"bound_nm": 0.0}, "bound_nm"),
        ({"limits": Limits(largest_us=np.nan)}, "largest_us"),
        ({"limits": {"triceps": Limits(rise_us=np.nan)}}, "rise_us"),
        ({"limits": {"triceps": Limits(shortest_us=np.nan)}}, "shortest_us"),
        ({"limits": {"biceps": Limits(dose_us=np.nan)}}, "dose_us"),
        ({"limits": {"biceps": Limits(dose_us=-1.0)}}, "dose_us"),
        ({"limits": {"calf": Limits()}}, "channel"),
    ],
)
def test_what_is_no_number_or_no_channel_is_refused(told: dict[str, Any], place: str) -> None:
    with pytest.raises(IdentifyError) as caught:
        invert(joint(), **({"torque_nm": np.zeros(40)} | told))
    assert caught.value.place == place and caught.value.fix


def test_nothing_wanted_is_nothing_sent() -> None:
    found = invert(joint(), np.zeros(80), co_contraction="constant")
    assert all(own.max() == 0.0 for own in found.pulse_width_us.values()) and found.whole_fit_percent is None


def test_as_json() -> None:
    found = muscles.invert(joint(), moves(), co_contraction="stiffness")
    told = json.loads(json.dumps(found.to_dict()))
    assert told["co_contraction"] == "stiffness" and set(told["pulse_width_us"]) == set(LARGEST_NM)
    assert len(told["muscle_torque_nm"]["triceps"]) == len(told["reference_torque_nm"]) == moves().size
    assert len(told["unreachable"]) == len(found.unreachable) and "2 channels" in str(found)
