"""The devices without ports: each method's contract, and that nothing but settings and inputs decides."""

from __future__ import annotations

import hashlib

import pytest

from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode4
from tests.hardware_sim.virtual_host import LL_CONFIG, LL_INIT, VirtualHost, biphasic, config

PULSE = config(*biphasic(250, 20))
INIT_TO_ACK_S, PULSE_TO_ACK_S = 0.040, 600e-6


def played(step_s: float, arm: str | None = None, faults: tuple[str, ...] = (), **settings: object) -> str:
    """A digest of all that devices do in a second of pulses, advanced by steps."""
    devices = make_devices(Settings(noise_seed=7, **settings), arm, epoch_us=1)
    written, frames = [], []
    devices.received(0.0, ScienceMode4.encode(Packet(1, LL_INIT, b"\x00")))
    for name in faults:
        devices.faults.on(name, {}, for_s=0.7)
    for k in range(1, 40):
        devices.received(0.025 * k, ScienceMode4.encode(Packet(k, LL_CONFIG, PULSE)))
        for n in range(1, int(0.025 / step_s)):
            devices.advance(0.025 * k + n * step_s)
            written += devices.take_bytes()
            frames += devices.take_frames()
    devices.advance(1.0)
    written += devices.take_bytes()
    frames += devices.take_frames()
    assert len(devices.electrodes.log) > 30
    return hashlib.sha256(repr((written, frames, devices.electrodes.log, devices.state())).encode()).hexdigest()


LOSSES = ("frames_dropped", "torque_nan", "frames_corrupt", "delivery_jitter")


@pytest.mark.parametrize(
    "described",
    [
        {},
        {"faults": LOSSES},
        {"arm": "robot", "faults": (*LOSSES, "angle_jump"), "clock_jitter_us": 50.0},
        {"cell": "counts", "samples_per_frame": 3, "clock_ppm": 200.0, "patient": "changing"},
    ],
)
def test_inputs_decide_and_how_often_time_advances_does_not(described: dict[str, object]) -> None:
    seen = {played(step_s, **described) for step_s in (0.001, 0.0125)}
    assert len(seen) == 1


def test_bytes_carry_the_time_at_which_they_were_written() -> None:
    devices = make_devices(Settings())
    assert devices.next_s() is None
    devices.received(1.0, ScienceMode4.encode(Packet(1, LL_INIT, b"\x00")))
    assert devices.take_bytes() == []
    assert devices.next_s() == pytest.approx(1.0 + INIT_TO_ACK_S)
    devices.advance(2.0)
    devices.received(0.5, ScienceMode4.encode(Packet(2, LL_CONFIG, PULSE)))  # late: it comes now
    devices.advance(3.0)
    times_s = [time_s for time_s, _ in devices.take_bytes()]
    assert times_s == pytest.approx([1.0 + INIT_TO_ACK_S, 2.0 + PULSE_TO_ACK_S])
    assert devices.electrodes.log[0].time_s == 2.0
    assert devices.take_bytes() == []


def test_frames_carry_the_time_of_their_last_sample_whatever_the_sensors_clock_says() -> None:
    devices = make_devices(Settings(samples_per_frame=3, clock_ppm=1000.0, rate_hz=1000.0), epoch_us=5_000_000)
    devices.advance(0.05)
    frames = devices.take_frames()
    assert [frame.time_s for frame in frames] == pytest.approx([(3 * n + 2) / 1001 for n in range(len(frames))])
    assert [frame.time_us for frame in frames] == [5_000_000 + 1000 * (3 * n + 2) for n in range(len(frames))]
    assert devices.take_frames() == []


def test_nothing_passes_while_a_cable_is_unplugged() -> None:
    host = VirtualHost(cell="canopen")
    devices, heard = host.devices, []
    devices.on_stimulator_cable = devices.on_cell_cable = heard.append
    devices.frame_received(0.0, 0, b"\x01\x00")
    devices.faults.on("stimulator_unplugged", {"mid_frame": True}, for_s=1.0)
    devices.faults.on("cell_unplugged", {}, for_s=1.0)
    assert (devices.stimulator_plugged, devices.load_cell.plugged) == (False, False)
    assert devices.take_bytes() == [(0.0, bytes.fromhex("f0815581"))]
    devices.received(0.5, ScienceMode4.encode(Packet(1, LL_INIT, b"\x00")))
    devices.frame_received(0.5, 0, b"\x02\x00")
    devices.advance(1.5)
    assert devices.take_frames()[0].time_s == pytest.approx(1.0)  # it was not stopped
    assert heard == [False, False, True, True]
    assert host.result(LL_CONFIG, PULSE) == 7  # nor was the stimulator initialised
    assert host.result(LL_INIT, b"\x00") == 0


def test_a_rehastim_offers_a_connection_only_to_a_host_that_reads() -> None:
    devices = make_devices(Settings(stimulator="rehastim2"))
    devices.advance(1.6)
    assert len(devices.take_bytes()) == 1  # the others would wait behind it
    devices.unread_bytes = lambda: 1
    devices.advance(2.6)
    assert devices.take_bytes() == []


def test_a_power_cycle_forgets_all_but_what_has_happened() -> None:
    host = VirtualHost()
    assert (host.result(LL_INIT, b"\x00"), host.result(LL_CONFIG, PULSE)) == (0, 0)
    host.devices.received(0.6, ScienceMode4.encode(Packet(1, LL_CONFIG, PULSE)))
    host.devices.power_cycle()
    assert host.ask(62).data == b"\x00\x00\x00"
    assert host.samples()[0][1] == pytest.approx(80, abs=1)  # its counter began at 0
    assert len(host.devices.electrodes.log) == host.devices.state()["pulses_received"] == 2
