"""Pulses at an output of the stimulator without a pair of electrodes."""

from __future__ import annotations

import pytest

from stimrig.hardware_sim.errors import HardwareSimError
from tests.hardware_sim.bench_board import biphasic, config
from tests.hardware_sim.virtual_host import VirtualHost

LL_INIT, LL_CONFIG = 0, 2
OK, ELECTRODE = 0, 10
PULSE = biphasic(300, 20)


def fire(host: VirtualHost, channel: int, connector: int = 0) -> int:
    """Result of one pulse there, with 50 ms after it."""
    (packet,) = host.ask(LL_CONFIG, config(*PULSE, channel=channel, connector=connector), wait_s=0.05)
    return packet.data[0]


def test_an_output_without_a_pair_is_an_electrode_error() -> None:
    host = VirtualHost()
    host.result(LL_INIT, b"\x00")
    assert [fire(host, channel) for channel in range(2)] == [OK, ELECTRODE]
    assert fire(host, 0, connector=1) == ELECTRODE
    assert [pulse.output for pulse in host.devices.electrodes.log] == [(0, 0), (0, 1), (1, 0)]


def test_the_electrode_comes_off() -> None:
    host = VirtualHost()
    host.result(LL_INIT, b"\x00")
    for output, result in ((0.0, ELECTRODE), (1.0, ELECTRODE), (2.0, OK)):
        host.devices.faults.on("electrode_error", {"output": output})
        assert fire(host, 0) == result
    with pytest.raises(HardwareSimError, match="0 to 8"):
        host.devices.faults.on("electrode_error", {"output": 9.0})
    host.devices.faults.off("electrode_error")
    assert fire(host, 0) == OK
