"""The hidden patient on the wire's side: same muscle as off line, jitter does not tear holes, the secret is kept."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from stimrig.hardware_sim import hidden
from stimrig.hardware_sim.hidden.chain import simulate
from stimrig.hardware_sim.hidden.live import HiddenMuscle
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from stimrig.hardware_sim.settings import Settings

pytestmark = pytest.mark.slow

RATE_HZ = 1600


def play(muscle: Any, scenario: Scenario, seconds: float, late_s: np.ndarray | float = 0.0) -> np.ndarray:
    """What a cell reads of it at 1600 Hz while the scenario's design is sent, pulse by pulse."""
    width = scenario.design.width_us
    at = np.arange(width.size) * 0.025 + late_s
    converted_nm = getattr(muscle, "converted_nm", lambda torque_nm, _: torque_nm)
    torque = np.empty(round(seconds * RATE_HZ))
    pulse = 0
    for k in range(torque.size):
        while pulse < width.size and at[pulse] <= k / RATE_HZ:
            if width[pulse] > 0.0:
                muscle.pulse(float(at[pulse]), float(width[pulse]), 20.0)
            pulse += 1
        torque[k] = converted_nm(muscle.torque_nm(k / RATE_HZ), k / RATE_HZ)
    return torque


@pytest.mark.parametrize("effect", [None, "fatigue", "recruitment_hysteresis", "catch_like", "sensor_clipping"])
def test_live_and_off_line_are_one_muscle(effect: str | None) -> None:
    scenario = draw_scenario((effect,) if effect else (), "strong", 400)
    off_line = simulate(scenario.base, scenario.stages(), scenario.design, 1.0 / RATE_HZ)
    live = play(HiddenMuscle(scenario), scenario, 12.0)
    assert off_line[: live.size].max() > 0.2 * scenario.base.largest_nm
    assert np.abs(live - off_line[: live.size]).max() < 1e-3


def test_jitter_delays_but_tears_no_holes() -> None:
    scenario = draw_scenario(("fatigue",), "middle", 401)
    late = np.random.default_rng(1).uniform(0.0, 0.004, scenario.design.width_us.size)
    steady = play(HiddenMuscle(scenario), scenario, 12.0, np.full_like(late, 0.002))
    jittered = play(HiddenMuscle(scenario), scenario, 12.0, late)
    assert np.sqrt(np.mean((jittered - steady) ** 2)) < 0.01 * scenario.base.largest_nm
    assert jittered.max() == pytest.approx(steady.max(), rel=0.01)


def test_torque_dies_away_once_pulses_stop_and_less_current_recruits_less() -> None:
    scenario = draw_scenario((), "weak", 402)
    full, weak = HiddenMuscle(scenario), HiddenMuscle(scenario)
    for k in range(80):
        for muscle, current_ma in ((full, 20.0), (weak, 10.0)):
            muscle.torque_nm(k * 0.025)
            muscle.pulse(k * 0.025, scenario.base.largest_width_us, current_ma)
    assert full.torque_nm(2.0) == pytest.approx(scenario.base.largest_nm, rel=0.15)
    assert weak.torque_nm(2.0) < full.torque_nm(2.0)
    assert abs(full.torque_nm(12.0)) < 0.01 * scenario.base.largest_nm


def test_a_clipped_reading_stays_clipped_after_the_noise() -> None:
    scenario = draw_scenario(("sensor_clipping",), "strong", 403)
    muscle = HiddenMuscle(scenario)
    rail = muscle.converted_nm(10.0 * scenario.base.largest_nm, 0.0)
    assert rail < scenario.base.largest_nm
    assert play(muscle, scenario, 12.0).max() <= rail


def test_the_emulated_cell_converts_after_its_noise() -> None:
    """Flat tops on the wire: many samples exactly at the rail, none above it, whatever the noise."""
    scenario = draw_scenario(("sensor_clipping",), "strong", 403)
    muscle = HiddenMuscle(scenario)
    rail = muscle.converted_nm(10.0 * scenario.base.largest_nm, 0.0)
    cell = LoadCell(muscle, Settings(noise_nm=0.05, noise_seed=1))
    readings: list[float] = []
    cell.torque_hooks.append(lambda reading_nm, _: readings.append(reading_nm) or reading_nm)
    for k in range(80):
        muscle.pulse(k * 0.025, scenario.base.largest_width_us, 20.0)
        cell.produce((k + 1) * 0.025)
    assert max(readings) <= rail
    assert sum(reading == max(readings) for reading in readings) > 20


def test_reveal_tells_of_the_muscle_that_make_gives() -> None:
    kinds = set()
    for seed in range(40, 47):
        told = hidden.reveal(seed)
        json.dumps(told)
        hidden.draw_patient.cache_clear()  # or the scenario would be compared with itself
        assert told == hidden.reveal(seed)
        assert len(told["effects"]) == len(told["formulation"]) == len(told["parameters"])
        kinds.add((len(told["effects"]), told["outside_library"]))
    assert len(kinds) >= 3  # nothing, one, two, foreign

    seed = next(seed for seed in range(40, 80) if len(hidden.reveal(seed)["effects"]) == 1)
    largest_us, torque = hidden.reveal(seed)["base"]["largest_width_us"], []
    for muscle in (hidden.make(seed), hidden.make(seed)):
        for k in range(40):
            muscle.pulse(k * 0.025, largest_us, 20.0)
        torque.append(muscle.torque_nm(1.0))
    assert torque[0] == torque[1] != 0.0


def test_making_a_patient_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    hidden.make(60)
    assert capsys.readouterr() == ("", "")
