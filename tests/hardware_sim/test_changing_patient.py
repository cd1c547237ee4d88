"""The muscle that changes: against scipy where nothing changes, and each change against its own law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim
from scipy.stats import weibull_min

from bench.muscles.offline import simulate
from stimrig.hardware_sim import patients
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients.changing import ChangingMuscle, Parameters

pytestmark = pytest.mark.slow

PULSES_PER_S = 40
DEFAULT = Parameters()
THIRD_US = DEFAULT.threshold_us + DEFAULT.spread_us * float(weibull_min.ppf(1 / 3, DEFAULT.shape))
"""A train of this width gives a third of the largest torque."""


def play(muscle: ChangingMuscle, widths_us: np.ndarray, rate_hz: float = 400.0, begin_s: float = 0.0) -> np.ndarray:
    """Torque at the samples from the begin on, one width a pulse."""
    times = begin_s + np.arange(widths_us.size) / PULSES_PER_S
    torque = simulate(muscle, times, widths_us, 20.0, rate_hz, begin_s + widths_us.size / PULSES_PER_S)
    return torque[round(begin_s * rate_hz) :]


def session(trials: int, rest_s: float = 15.0, width_us: float = THIRD_US, trial_s: float = 12.0) -> np.ndarray:
    """So many contractions, each with its rest before it."""
    one = np.r_[np.zeros(round(rest_s * PULSES_PER_S)), np.full(round(trial_s * PULSES_PER_S), width_us)]
    return np.tile(one, trials)


def varied(seconds: float) -> np.ndarray:
    return np.repeat(np.random.default_rng(3).uniform(0.0, 300.0, round(seconds * 4)), 10)


def recruitment(widths_us: np.ndarray, shift_us: float = 0.0) -> np.ndarray:
    p = DEFAULT
    return p.largest_nm * weibull_min.cdf(widths_us, p.shape, p.threshold_us + shift_us, p.spread_us)


@pytest.mark.parametrize("damping", [0.5, 1.0, 1.4])
@pytest.mark.parametrize("current_ma", [20.0, 15.0])
def test_with_the_defaults_it_is_scipys_and_does_not_change(damping: float, current_ma: float) -> None:
    widths, period_s = varied(20.0), DEFAULT.natural_period_s
    times = np.arange(widths.size) / PULSES_PER_S
    muscle = ChangingMuscle(Parameters(damping_ratio=damping))
    torque = simulate(muscle, times, widths, current_ma, 1600.0, 20.0)
    held = np.repeat(recruitment(widths * current_ma / 20.0), 40)
    system = ([1], [period_s**2, 2 * damping * period_s, 1])
    expected = lsim(system, held, np.arange(held.size) / 1600, interp=False)[1]
    np.testing.assert_allclose(torque, expected, atol=1e-6)
    assert (muscle.gain, muscle.time_scale, muscle.shift_us(1e4)) == (1.0, 1.0, 0.0)


@pytest.mark.parametrize("recovery_s", [60.0, 200.0])
def test_ten_trials_with_rests_lose_forty_percent_of_the_torque(recovery_s: float) -> None:
    muscle = ChangingMuscle(Parameters(fatigue_share=0.4, fatigue_recovery_s=recovery_s))
    torque = play(muscle, session(10))
    assert torque[-1] / (DEFAULT.largest_nm / 3) == pytest.approx(0.6, abs=0.004)
    ends = torque[np.arange(1, 11) * 27 * 400 - 1]
    assert np.all(np.diff(ends) < 0)


def test_potentiation_rises_with_use_and_fades() -> None:
    muscle = ChangingMuscle(Parameters(potentiation_share=0.3))
    torque = play(muscle, session(10))
    assert torque[-1] / (DEFAULT.largest_nm / 3) == pytest.approx(1.3, abs=0.003)
    muscle.torque_nm(270.0 + 60.0)
    assert muscle.gain - 1 == pytest.approx(0.3 * np.exp(-1), rel=0.01)


@pytest.mark.parametrize("share", [0.3, -0.2])
def test_speed_changes_with_use_and_leaves_the_plateau(share: float) -> None:
    muscle = ChangingMuscle(Parameters(slowing_share=share))
    torque = play(muscle, session(10))
    assert muscle.time_scale == pytest.approx(1 + share, abs=0.003)
    assert torque[-1] == pytest.approx(DEFAULT.largest_nm / 3, rel=1e-3)
    trials = torque.reshape(10, 27 * 400)[:, 15 * 400 :]
    half_s = np.argmax(trials > DEFAULT.largest_nm / 6, axis=1) / 400
    assert half_s[-1] / half_s[0] == pytest.approx(1 + 0.9 * share, abs=0.06)


@pytest.mark.parametrize("drift_us", [12.0, -9.0])
def test_threshold_drifts_and_settles(drift_us: float) -> None:
    muscle = ChangingMuscle(Parameters(drift_us=drift_us, drift_settling_s=50.0))
    begin_s = 30.0  # nothing drifts before the first pulse
    torque = play(muscle, np.full(40 * 300, 150.0), begin_s=begin_s)
    for at_s in (50.0, 299.9):
        shift_us = drift_us * (1 - np.exp(-at_s / 50.0))
        assert torque[round(at_s * 400)] == pytest.approx(recruitment(np.array(150.0), shift_us), rel=0.01)
    assert muscle.shift_us(1e4) == pytest.approx(drift_us)


@pytest.mark.parametrize(
    ("kind", "lasts_s", "risen_s"), [("spasm", 0.2, 0.02), ("spasm", 1.5, 0.15), ("effort", 2.0, 1.0)]
)
def test_spasm_and_effort_come_in_one_contraction(kind: str, lasts_s: float, risen_s: float) -> None:
    named = {f"{kind}_contraction": 2, f"{kind}_nm": 2.5, f"{kind}_begins_s": 4.0, f"{kind}_lasts_s": lasts_s}
    widths = session(3)
    added = play(ChangingMuscle(Parameters(**named)), widths) - play(ChangingMuscle(), widths)
    begin = (27 + 15 + 4) * 400
    end = begin + round(lasts_s * 400)
    assert np.all(np.abs(np.delete(added, np.s_[begin:end])) < 1e-12)
    assert added.max() == pytest.approx(2.5) and added.min() > -1e-12
    assert added[begin + round(risen_s * 400)] == pytest.approx(2.5)


def test_short_pauses_do_not_begin_a_contraction() -> None:
    muscle = ChangingMuscle()
    play(muscle, np.r_[session(4, rest_s=4.0, trial_s=2.0), session(2)])
    assert muscle.contractions == 3


def everything() -> Parameters:
    return Parameters(
        fatigue_share=0.4, potentiation_share=0.2, slowing_share=0.3, drift_us=8.0, spasm_contraction=1,
        effort_contraction=1,
    )  # fmt: skip


def test_the_times_of_reading_do_not_matter() -> None:
    widths = varied(20.0)
    often, seldom = (play(ChangingMuscle(everything()), widths, rate_hz) for rate_hz in (1600.0, 100.0))
    np.testing.assert_allclose(often[::16], seldom, atol=1e-9)


def test_a_shift_may_be_negative_a_time_and_a_share_of_one_may_not() -> None:
    assert isinstance(patients.make("changing", {"drift_us": -5.0}), ChangingMuscle)
    for name, value, told in (("spasm_lasts_s", -1.0, "above zero"), ("fatigue_share", 1.0, "share")):
        with pytest.raises(HardwareSimError, match=told):
            patients.make("changing", {name: value})
