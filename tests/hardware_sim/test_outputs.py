"""Several pairs of electrodes at one stimulator: which output is wired to what, and what the emulator says of it."""

from __future__ import annotations

from typing import Any

import pytest

from stimrig.hardware_sim.errors import ArmError, HardwareSimError
from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.joint_records import draw_joint
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators.board import Electrodes
from tests.hardware_sim.bench_board import NotingMuscle, biphasic, config
from tests.hardware_sim.emulated import emulated
from tests.hardware_sim.virtual_host import VirtualHost

LL_INIT, LL_CONFIG = 0, 2
OK, ELECTRODE = 0, 10
PULSE = biphasic(300, 20)


def fire(host: VirtualHost, channel: int, connector: int = 0) -> int:
    """Result of one pulse there, with 50 ms after it."""
    (packet,) = host.ask(LL_CONFIG, config(*PULSE, channel=channel, connector=connector), wait_s=0.05)
    return packet.data[0]


def test_each_output_has_a_muscle_of_its_own_and_any_pulse_raises_sync() -> None:
    muscles = {(connector, channel): NotingMuscle() for connector in (0, 1) for channel in range(4)}
    syncs: list[bool] = []
    electrodes = Electrodes(muscles, lambda: syncs.append(True))
    for k, output in enumerate(muscles):
        assert electrodes.fire(0.1 * k, PULSE, output, "test")
    assert [muscle.pulses for muscle in muscles.values()] == [[(0.1 * k, 300.0, 20.0)] for k in range(8)]
    assert [pulse["output"] for pulse in electrodes.pulses()] == list(muscles)
    assert len(syncs) == electrodes.delivered_pulses == 8
    assert not Electrodes(NotingMuscle()).fire(0.0, PULSE, (0, 1), "test")


def test_two_muscles_pull_against_each_other() -> None:
    torques_nm = []
    for channel in (0, 1):
        host = VirtualHost(patient="two_muscles:5", noise_nm=0.0)
        host.result(LL_INIT, b"\x00")
        for _ in range(30):
            assert fire(host, channel) == OK
        torques_nm.append(host.devices.load_cell.torque_nm)
        assert {pulse.output for pulse in host.devices.electrodes.log} == {(0, channel)}
    assert torques_nm[0] > 0.5 and torques_nm[1] < -0.5


def test_an_output_without_a_pair_is_an_electrode_error() -> None:
    host = VirtualHost(patient="two_muscles:5")
    host.result(LL_INIT, b"\x00")
    assert [fire(host, channel) for channel in range(4)] == [OK, OK, ELECTRODE, ELECTRODE]
    assert fire(host, 0, connector=1) == ELECTRODE
    one = VirtualHost()
    one.result(LL_INIT, b"\x00")
    assert [fire(one, channel) for channel in range(2)] == [OK, ELECTRODE]


def test_where_pairs_are_plugged_in_is_a_setting() -> None:
    host = VirtualHost(patient="two_muscles:5", outputs="2.4,1.3")
    host.result(LL_INIT, b"\x00")
    assert [fire(host, 0), fire(host, 2), fire(host, 3, connector=1)] == [ELECTRODE, OK, OK]
    for _ in range(20):
        fire(host, 3, connector=1)
    assert host.devices.load_cell.torque_nm > 0.2


def test_one_electrode_comes_off_or_all_do() -> None:
    host = VirtualHost(patient="two_muscles:5")
    host.result(LL_INIT, b"\x00")
    for output, results in ((0.0, [ELECTRODE, ELECTRODE]), (1.0, [ELECTRODE, OK]), (2.0, [OK, ELECTRODE])):
        host.devices.faults.on("electrode_error", {"output": output})
        assert [fire(host, channel) for channel in (0, 1)] == results
    with pytest.raises(HardwareSimError, match="0 to 8"):
        host.devices.faults.on("electrode_error", {"output": 9.0})
    host.devices.faults.off("electrode_error")
    assert [fire(host, channel) for channel in (0, 1)] == [OK, OK]


@pytest.mark.parametrize("outputs", ["", "1.5", "3.1", "1.1,1.1", "1.1;1.2", "1,2"])
def test_outputs_that_there_are_not(outputs: str) -> None:
    with pytest.raises(HardwareSimError, match="--outputs"):
        Settings(outputs=outputs)


@pytest.mark.parametrize(
    ("described", "arm", "error"),
    [
        ({"patient": "two_muscles:5", "outputs": "1.1"}, None, "--outputs"),
        ({"patient": "two_muscles:5"}, "held", "--arm"),
        ({"patient": "two_muscles:-1"}, None, "seed"),
        ({"patient": "two_muscles:"}, None, "patient"),
    ],
)
def test_what_makes_no_rig_of_two_muscles(described: dict[str, Any], arm: str | None, error: str) -> None:
    with pytest.raises((ArmError, HardwareSimError), match=error):
        make_devices(Settings(**described), arm)


@pytest.mark.wire
def test_two_muscles_on_the_wire() -> None:
    with emulated("--patient", "two_muscles:5", "--noise-nm", "0") as rig:
        assert rig.ready["outputs"] == [[0, 0], [0, 1]]
    assert draw_joint(5).truth["seed"] == 5
