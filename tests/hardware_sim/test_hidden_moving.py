"""Hidden patients whose joint moves: on the wire's side the same as off line, and sealed like the others."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from stimrig.hardware_sim import hidden
from stimrig.hardware_sim.__main__ import main
from stimrig.hardware_sim.arm.description import Arm
from stimrig.hardware_sim.arm.limb import Limb
from stimrig.hardware_sim.arm.tissue import bare
from stimrig.hardware_sim.hidden.chain import simulate
from stimrig.hardware_sim.hidden.library import MOVING
from stimrig.hardware_sim.hidden.live import HiddenMuscle
from stimrig.hardware_sim.hidden.scenario import Scenario, draw_scenario
from tests.hardware_sim.emulated import emulated, wait_for
from tests.hardware_sim.test_hidden_patient import RATE_HZ, play

pytestmark = pytest.mark.slow
SECONDS = 12.0


def played(scenario: Scenario, late_s: float = 0.0) -> np.ndarray:
    """Torque of the limb at 1600 Hz, its joint moving as in the design, pulses later than planned by up to `late_s`."""
    hz, size, phase = scenario.design.movement or ((), (), ())
    waves = {
        "hz": list(map(float, hz)),
        "deg": list(map(float, np.degrees(size))),
        "phase_rad": list(map(float, phase)),
    }
    limb = Limb(HiddenMuscle(scenario), Arm("waves", {**waves, "deg_s": 1000.0}, bare()))
    late = np.random.default_rng(1).uniform(0.0, late_s or 1e-12, scenario.design.width_us.size)
    return play(limb, scenario, SECONDS, late)


@pytest.mark.parametrize("effect", sorted(MOVING))
def test_on_the_wires_side_and_off_line_are_one_arm(effect: str) -> None:
    scenario = draw_scenario((effect,), "strong", 400)
    off_line = simulate(scenario.base, scenario.stages(), scenario.design, 1.0 / RATE_HZ)[: round(SECONDS * RATE_HZ)]
    settled = slice(RATE_HZ, None)  # after the joint was brought into its movement
    assert np.abs(played(scenario)[settled] - off_line[settled]).max() < 0.02 * scenario.base.largest_nm
    held = replace(scenario, design=replace(scenario.design, movement=None))
    assert np.abs(played(held)[settled] - off_line[settled]).max() > 0.05 * scenario.base.largest_nm


def test_going_back_for_a_late_pulse_finds_the_joint_where_it_was() -> None:
    scenario = draw_scenario(("torque_velocity",), "strong", 401)
    assert np.abs(played(scenario, 0.004) - played(scenario)).max() < 0.06 * scenario.base.largest_nm


def test_the_seed_hides_effects_of_the_movement_and_others() -> None:
    hidden_effects = [hidden.reveal(seed, moving=True)["effects"] for seed in range(100, 108)]
    moving = [names for names in hidden_effects if names and names[0] in MOVING]
    assert 0.3 < len(moving) / len(hidden_effects) < 1.0
    assert len({names[0] for names in moving}) > 1
    assert set(hidden.movement(100)) == {"hz", "deg", "phase_rad"}
    assert all(amplitude >= 10.0 for amplitude in hidden.movement(100)["deg"])


def test_another_patient_than_without_an_arm(capsys: pytest.CaptureFixture[str]) -> None:
    told = []
    for arguments in (["--reveal", "104"], ["--reveal", "104", "--arm", "design"]):
        assert main(arguments) == 0
        told.append(json.loads(capsys.readouterr().out))
    assert told[1] == json.loads(json.dumps(hidden.reveal(104, moving=True)))
    assert told[0] == json.loads(json.dumps(hidden.reveal(104)))


@pytest.mark.wire
def test_the_design_moves_the_arm_and_the_sensor_is_there() -> None:
    with emulated("--hidden", "101", "--arm", "design") as rig:
        assert rig.ready["arm"] == "waves"
        assert rig.ready["angle_sensor"]["frame_id"] == 386
        assert "torque" not in json.dumps(rig.ready)
        angle_deg = rig.ask(cmd="state")["angle_deg"]
        wait_for(lambda: abs(rig.ask(cmd="state")["angle_deg"] - angle_deg) > 1.0)
        assert not rig.ask(cmd="arm", mode="free")["ok"]
        assert rig.ask(cmd="arm", mode="robot")["ok"]


def test_design_is_for_hidden_patients(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--arm", "design"]) == 2
    assert "neither a file nor one of" in capsys.readouterr().err
