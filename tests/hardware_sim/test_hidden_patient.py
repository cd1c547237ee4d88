"""The hidden patient on the wire's side: same muscle as off line, jitter does not tear holes, the secret is kept."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig.hardware_sim import hidden
from stimrig.hardware_sim.__main__ import main
from stimrig.hardware_sim.arm.limb import Arm, Limb
from stimrig.hardware_sim.arm.tissue import bare
from stimrig.hardware_sim.hidden.chain import simulate
from stimrig.hardware_sim.hidden.library import MOVING
from stimrig.hardware_sim.hidden.live import HiddenMuscle
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from stimrig.hardware_sim.settings import Settings
from tests.hardware_sim.emulated import emulated, wait_for

pytestmark = pytest.mark.slow

RATE_HZ = 1600
SECONDS = 12.0


def off_line(scenario: Scenario) -> np.ndarray:
    torque = simulate(scenario.base, scenario.stages(), scenario.design, 1.0 / RATE_HZ)
    return torque[: round(SECONDS * RATE_HZ)]


def play(muscle: Any, scenario: Scenario, late_s: np.ndarray | float = 0.0) -> np.ndarray:
    """What a cell reads of it at 1600 Hz while the scenario's design is sent, pulse by pulse."""
    width = scenario.design.width_us
    at = np.arange(width.size) * 0.025 + late_s
    converted_nm = getattr(muscle, "converted_nm", lambda torque_nm, _: torque_nm)
    torque = np.empty(round(SECONDS * RATE_HZ))
    pulse = 0
    for k in range(torque.size):
        while pulse < width.size and at[pulse] <= k / RATE_HZ:
            if width[pulse] > 0.0:
                muscle.pulse(float(at[pulse]), float(width[pulse]), 20.0)
            pulse += 1
        torque[k] = converted_nm(muscle.torque_nm(k / RATE_HZ), k / RATE_HZ)
    return torque


def play_moving(scenario: Scenario, late_s: float = 1e-12) -> np.ndarray:
    """Torque of the limb, its joint moving as in the design, pulses later than planned by up to `late_s`."""
    hz, size, phase = scenario.design.movement or ((), (), ())
    waves = {"hz": [*map(float, hz)], "deg": np.degrees(size).tolist(), "phase_rad": [*map(float, phase)]}
    limb = Limb(HiddenMuscle(scenario), Arm("waves", {**waves, "deg_s": 1000.0}, bare()))
    return play(limb, scenario, np.random.default_rng(1).uniform(0.0, late_s, scenario.design.width_us.size))


@pytest.mark.parametrize("effect", [None, "fatigue", "recruitment_hysteresis", "catch_like", "sensor_clipping"])
def test_live_and_off_line_are_one_muscle(effect: str | None) -> None:
    scenario = draw_scenario((effect,) if effect else (), "strong", 400)
    torque = off_line(scenario)
    assert torque.max() > 0.2 * scenario.base.largest_nm
    assert np.abs(play(HiddenMuscle(scenario), scenario) - torque).max() < 1e-3


@pytest.mark.parametrize("effect", sorted(MOVING))
def test_on_the_wires_side_and_off_line_are_one_arm(effect: str) -> None:
    scenario = draw_scenario((effect,), "strong", 400)
    torque, settled = off_line(scenario), slice(RATE_HZ, None)  # after the joint was brought into its movement
    assert np.abs(play_moving(scenario) - torque)[settled].max() < 0.02 * scenario.base.largest_nm
    held = replace(scenario, design=replace(scenario.design, movement=None))
    assert np.abs(play_moving(held) - torque)[settled].max() > 0.05 * scenario.base.largest_nm


@pytest.mark.parametrize("late_ms", [7.0, 12.0, 18.0])
def test_a_late_pulse_acts_whole_and_so_does_the_next(late_ms: float) -> None:
    """What the pulses drive is the same in the end; the next one cut a late one, which looked like an effort."""
    scenario = draw_scenario((), "middle", 401)
    width_us = np.maximum(scenario.design.width_us, 0.5 * scenario.base.largest_width_us)  # a train without rests
    scenario = replace(scenario, design=replace(scenario.design, width_us=width_us))
    late = np.zeros(width_us.size)
    late[[100, 110, 111, 130]] = late_ms / 1e3  # twice alone, twice in a row
    steady, moved = (play(HiddenMuscle(scenario), scenario, one) for one in (0.0, late))
    drive = float(steady.mean()) * 0.025  # of one pulse, N·m·s
    assert np.abs(moved - steady).max() > 0.001 * scenario.base.largest_nm
    assert abs(float(np.sum(moved - steady)) / RATE_HZ) < 0.1 * drive


def test_going_back_for_a_late_pulse_finds_the_joint_where_it_was() -> None:
    scenario = draw_scenario(("torque_velocity",), "strong", 401)
    assert np.abs(play_moving(scenario, 0.004) - play_moving(scenario)).max() < 0.06 * scenario.base.largest_nm


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


def test_the_emulated_cell_converts_after_its_noise() -> None:
    """Flat tops on the wire: many samples exactly at the rail, none above it, whatever the noise."""
    scenario = draw_scenario(("sensor_clipping",), "strong", 403)
    muscle = HiddenMuscle(scenario)
    rail = muscle.converted_nm(10.0 * scenario.base.largest_nm, 0.0)
    assert rail < scenario.base.largest_nm
    cell = LoadCell(muscle, Settings(noise_nm=0.05, noise_seed=1))
    readings: list[float] = []
    cell.torque_hooks.append(lambda reading_nm, _: readings.append(reading_nm) or reading_nm)
    for k in range(80):
        muscle.pulse(k * 0.025, scenario.base.largest_width_us, 20.0)
        cell.produce((k + 1) * 0.025)
    assert max(readings) <= rail
    assert sum(reading == max(readings) for reading in readings) > 20


def test_reveal_tells_of_the_muscle_that_make_gives(capsys: pytest.CaptureFixture[str]) -> None:
    kinds = set()
    for seed in range(40, 44):
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
    assert capsys.readouterr() == ("", ""), "making a patient prints nothing"


def test_the_seed_hides_effects_of_the_movement_and_others(capsys: pytest.CaptureFixture[str]) -> None:
    hidden_effects = [hidden.reveal(seed, moving=True)["effects"] for seed in range(100, 105)]
    moving = [names for names in hidden_effects if names and names[0] in MOVING]
    assert 0.3 < len(moving) / len(hidden_effects) < 1.0
    assert len({names[0] for names in moving}) > 1
    for arm in ([], ["--arm", "design"]):
        assert main(["--reveal", "104", *arm]) == 0
        assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(hidden.reveal(104, moving=bool(arm))))
    assert set(hidden.movement(100)) == {"hz", "deg", "phase_rad"}
    assert all(amplitude >= 10.0 for amplitude in hidden.movement(100)["deg"])


@pytest.mark.wire
def test_the_design_moves_the_arm_and_the_sensor_is_there() -> None:
    with emulated("--hidden", "101", "--arm", "design") as rig:
        assert rig.ready["arm"] == "waves"
        assert rig.ready["angle_sensor"]["frame_id"] == 386
        assert "torque" not in json.dumps(rig.ready)
        angle_deg = rig.ask(cmd="state")["angle_deg"]
        wait_for(lambda: abs(rig.ask(cmd="state")["angle_deg"] - angle_deg) > 1.0)
        assert rig.ask(cmd="arm", mode="robot")["ok"]
