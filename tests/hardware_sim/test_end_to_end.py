"""Pulses in on the serial line, torque and sync out on the bus: the whole emulated rig against the offline muscle."""

from __future__ import annotations

import struct
import time

import can
import numpy as np
import pytest
import serial

from hardware_sim.offline import simulate
from hardware_sim.patients import registry
from hardware_sim.stimulators.framing import Packet
from hardware_sim.stimulators.sciencemode4 import encode
from tests.hardware_sim.bench_board import LL_CONFIG, LL_INIT, biphasic, config
from tests.hardware_sim.emulated import emulated, wait_for

pytestmark = pytest.mark.wire
LAYOUT = struct.Struct("<fHBB")
RATE_HZ = 1600.0


@pytest.mark.parametrize("patient", ["paper", "calcium"])
def test_the_wire_carries_what_the_muscle_does(patient: str) -> None:
    with emulated("--patient", patient, "--noise-nm", "0") as rig, can.Bus(**rig.ready["can"]) as bus:
        assert bus.recv(10.0) is not None
        line = serial.Serial(rig.ready["stimulator"], 3_000_000, stopbits=2, rtscts=True)
        line.write(encode(Packet(1, LL_INIT, b"\x00")))
        line.timeout = 10.0
        assert len(line.read(13)) == 13  # its answer: it is initialised now
        messages = []
        for k in range(40):
            line.write(encode(Packet(k, LL_CONFIG, config(*biphasic(300 if k % 10 < 7 else 200, 20)))))
            next_s = time.monotonic() + 0.025  # never sooner after the one before, however late that was
            while time.monotonic() < next_s:
                message = bus.recv(0.002)
                if message is not None:
                    messages.append(message)
        wait_for(lambda: len(rig.ask(cmd="pulses")["pulses"]) == 40)
        line.close()
        pulses = rig.ask(cmd="pulses")["pulses"]
    values = np.array([LAYOUT.unpack(message.data)[:3] for message in messages])
    counter = values[:, 1].astype(int)
    times_s = [pulse["time_s"] for pulse in pulses]
    widths_us = [pulse["width_us"] for pulse in pulses]
    duration_s = (counter[-1] + 1) / RATE_HZ
    torque_nm = simulate(registry.make(patient), times_s, widths_us, 20.0, RATE_HZ, duration_s)
    np.testing.assert_allclose(values[:, 0], torque_nm[counter], atol=2e-4)
    assert torque_nm.max() > 2.0

    seen = counter[values[:, 2].astype(int) & 1 == 1]
    due = np.ceil(np.array(times_s) * RATE_HZ).astype(int)
    np.testing.assert_array_equal(seen, due[due <= counter[-1]])
