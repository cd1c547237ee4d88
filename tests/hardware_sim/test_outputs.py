"""Pulses at an output of the stimulator without a pair of electrodes."""

from __future__ import annotations

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
