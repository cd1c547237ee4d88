"""Each hidden effect: at a strength it shows as much as it says, and it is integrated finely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stimrig.hardware_sim.hidden.base import Base, draw_base
from stimrig.hardware_sim.hidden.chain import Chain, combine, simulate
from stimrig.hardware_sim.hidden.design import make_design
from stimrig.hardware_sim.hidden.forms import Form
from stimrig.hardware_sim.hidden.kernels import NotSuited
from stimrig.hardware_sim.hidden.library import EFFECTS, OUTSIDERS, find_forms
from stimrig.hardware_sim.hidden.scenario import BANDS, draw_scenario, rng_of
from stimrig.hardware_sim.hidden.strength import EffectFreeFit, excess_nm

pytestmark = pytest.mark.slow

STEP_S = 1.0 / 1600.0
NOISE_SD_NM = 0.04
KNOWN = {**EFFECTS, **OUTSIDERS}
NAMES = list(KNOWN)
ALL = [(effect, index) for effect in NAMES for index in range(len(find_forms(KNOWN[effect])))]
# noise drawn at each step, or a moment that is rounded to a step and changes all that follows
RANDOM_BY_STEP = {
    ("voluntary_effort", "effort whenever a slow random drive is high"),
    ("mains_hum", "the grid's frequency wanders"),
}
"""Single formulations of the same kind: effect and the formulation's name."""
BY_STEP = {"tremor", "delay_jitter", "stick_slip", "slow_converter", "clonus"}


def written(effect: str, index: int, seed: int = 3) -> tuple[Base, Form]:
    """A base muscle on which this formulation can be written."""
    for attempt in range(30):
        rng = rng_of(seed, effect, str(index), str(attempt))
        base = draw_base(rng)
        try:
            return base, find_forms(KNOWN[effect])[index](rng, base)
        except NotSuited:
            continue
    raise AssertionError("no suitable base in 30")


@pytest.mark.parametrize(
    ("effect", "index"),
    # the first form of each effect; the others are for a campaign
    [pytest.param(*one, marks=[pytest.mark.campaign] if one[1] else []) for one in ALL],
)
def test_the_largest_magnitude_shows_and_a_finer_step_gives_the_same_torque(effect: str, index: int) -> None:
    base, formulation = written(effect, index)
    design = make_design("full", rng_of(2), float(base.largest_width_us), moving=True, validate_s=4.0)
    some, full = (combine(base, [(formulation, share * formulation.largest_magnitude)]) for share in (0.4, 1.0))
    plain = simulate(base, base.stages(), design, STEP_S)
    assert np.abs(simulate(base, full, design, STEP_S) - plain).max() > 0.05
    if effect in BY_STEP or (effect, find_forms(KNOWN[effect])[index].name) in RANDOM_BY_STEP:
        return
    coarse, fine = simulate(base, some, design, STEP_S), simulate(base, some, design, STEP_S / 4.0)[::4]
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.004 * base.largest_nm


DEVELOPMENT, KEPT_BACK = 200, 1200
"""Seeds: from 1000 on, formulations that are kept back may be drawn, too."""
DRAWN = [(strength, seed) for strength in BANDS for seed in (DEVELOPMENT, KEPT_BACK)]
SOME = {(0, ("weak", KEPT_BACK)), (3, ("strong", DEVELOPMENT))}
"""One of them of every third effect; the others are for a campaign."""


@pytest.mark.parametrize(
    ("effect", "strength", "seed"),
    [
        pytest.param(effect, *drawn, marks=[] if (place % 6, drawn) in SOME else [pytest.mark.campaign])
        for place, effect in enumerate(NAMES)
        for drawn in DRAWN
    ],
)
def test_strength_lands_in_its_band(effect: str, strength: str, seed: int) -> None:
    scenario = draw_scenario((effect,), strength, seed, noise_sd_nm=NOISE_SD_NM)
    low, high = BANDS[strength]
    assert low <= scenario.hidden[0].excess["counted_nm"] / NOISE_SD_NM <= high
    torque = simulate(scenario.base, scenario.stages(), scenario.design, STEP_S)
    assert np.all(np.isfinite(torque))
    assert np.abs(torque).max() < 3.0 * scenario.base.largest_nm + 2.0


def test_the_excess_is_that_of_a_fit_made_anew() -> None:
    scenario = draw_scenario(("fatigue",), "strong", 210, noise_sd_nm=NOISE_SD_NM)
    torque = simulate(scenario.base, scenario.stages(), scenario.design, STEP_S)[::40]
    residual = EffectFreeFit(scenario.base, scenario.design).fit(torque)
    again = excess_nm("larger", residual, scenario.design.held_out)
    assert again["held_out_nm"] == pytest.approx(scenario.hidden[0].excess["held_out_nm"], rel=0.05)


@pytest.mark.parametrize("steep", [False, True])
def test_a_base_muscle_leaves_the_yardstick_almost_nothing(steep: bool) -> None:
    left = []
    for seed in range(220, 250):
        scenario = draw_scenario((), "weak", seed, steep=steep)
        torque = simulate(scenario.base, scenario.stages(), scenario.design, STEP_S)[::40]
        residual = EffectFreeFit(scenario.base, scenario.design).fit(torque)
        left.append(np.sqrt(np.mean(residual[scenario.design.held_out] ** 2)))
    assert np.median(left) < 0.5 * NOISE_SD_NM
    # within a steep rise the ramp leaves one pulse every 1.5 µs: nobody could know the curve better
    assert np.percentile(left, 80 if steep else 95) < 1.5 * NOISE_SD_NM


def test_the_base_follows_the_closed_form_step_response() -> None:
    base = draw_base(rng_of(5))
    width = np.full(3200, float(base.largest_width_us))
    still = np.zeros_like(width)
    torque = Chain(base.stages(), base.largest_nm, STEP_S).run(width, still, still, still)
    t = np.arange(1, 3201) * STEP_S
    root = np.sqrt(complex(base.zeta**2 - 1.0))
    s1, s2 = (-base.zeta + root) / base.t_omega_s, (-base.zeta - root) / base.t_omega_s
    expected = base.largest_nm * (1.0 - (s2 * np.exp(s1 * t) - s1 * np.exp(s2 * t)) / (s2 - s1)).real
    assert np.abs(torque - expected).max() < 1e-6


def test_formulations_kept_back_are_not_drawn_for_development() -> None:
    for effect in EFFECTS:
        assert len(find_forms(EFFECTS[effect], 1000)) > len(find_forms(EFFECTS[effect], 999)) >= 3


def test_bursts_of_pulses_ripple_about_the_held_width() -> None:
    scenario = draw_scenario((), "weak", 240)
    held = simulate(scenario.base, scenario.stages(), scenario.design, STEP_S)
    bursts = replace(scenario, base=replace(scenario.base, burst_s=0.006))
    pulsed = simulate(bursts.base, bursts.stages(), bursts.design, STEP_S)
    ripple = np.abs(pulsed - held).max()
    period_means = [torque[: held.size // 40 * 40].reshape(-1, 40).mean(axis=1) for torque in (held, pulsed)]
    assert 1e-4 < ripple < 0.05 * scenario.base.largest_nm
    assert np.abs(period_means[1] - period_means[0]).max() < 0.6 * ripple


def test_steep_recruitment_rises_within_25_us() -> None:
    for seed in range(40):
        low, high = draw_base(rng_of(seed), steep=True).rise_us()
        assert 1.0 <= high - low <= 27.0
