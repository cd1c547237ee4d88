"""The vendor's published client against the emulated P24: an oracle that shares no code with it."""

from __future__ import annotations

import asyncio
import time

import pytest
from science_mode_4 import (
    Channel,
    ChannelPoint,
    Connector,
    DeviceP24,
    LowLevelHighVoltageSource,
    LowLevelMode,
    ResultAndError,
    SerialPortConnection,
    StimStatus,
)

from tests.hardware_sim.emulated import Emulated, emulated, wait_for

pytestmark = pytest.mark.wire
PULSE = (250, 20.0)


def shape(width_us: int, current_ma: float) -> list[ChannelPoint]:
    return [ChannelPoint(width_us, current_ma), ChannelPoint(100, 0), ChannelPoint(width_us, -current_ma)]


def acks(device: DeviceP24, count: int) -> list:
    found = []

    def read() -> bool:
        packet = device.packet_buffer.get_packet_from_buffer()
        if packet is not None:
            found.append(packet)
        return len(found) >= count

    wait_for(read)
    return found


async def opened(rig: Emulated) -> tuple[SerialPortConnection, DeviceP24]:
    connection = SerialPortConnection(rig.ready["stimulator"])
    connection.open()
    device = DeviceP24(connection)
    await device.initialize()
    return connection, device


def test_low_level() -> None:
    async def session(rig: Emulated) -> None:
        connection, device = await opened(rig)
        general, low = device.get_layer_general(), device.get_layer_low_level()
        assert general.device_id == "EMULATED24"
        assert general.science_mode_version == "4.0.0"
        assert await general.get_stim_status() == (StimStatus.NO_LEVEL_INITIALIZED, False)
        started_s = time.monotonic()
        await low.init(LowLevelMode.NO_MEASUREMENT, LowLevelHighVoltageSource.STANDARD)
        assert time.monotonic() - started_s >= 0.040
        assert await general.get_stim_status() == (StimStatus.LOW_LEVEL_INITIALIZED, True)
        for _ in range(20):
            low.send_channel_config(True, Channel.RED, Connector.YELLOW, shape(*PULSE))
            (ack,) = acks(device, 1)
            assert (ack.result, ack.channel, ack.connector) == (ResultAndError.NO_ERROR, 0, 0)
            await asyncio.sleep(0.02)
        rig.ask(cmd="fault", name="electrode_error")
        low.send_channel_config(True, Channel.RED, Connector.YELLOW, shape(*PULSE))
        assert acks(device, 1)[0].result == ResultAndError.ELECTRODE_ERROR
        rig.ask(cmd="fault", name="electrode_error", on=False)
        await low.stop()
        assert await general.get_stim_status() == (StimStatus.NO_LEVEL_INITIALIZED, False)
        connection.close()

    with emulated() as rig:
        asyncio.run(session(rig))
        pulses = rig.ask(cmd="pulses")["pulses"]
        assert [(p["width_us"], p["current_ma"]) for p in pulses] == [PULSE] * 21
        assert [p["delivered"] for p in pulses] == [True] * 20 + [False]
        state = rig.ask(cmd="state")
        assert (state["unbalanced_pulses"], state["corrupt_frames"], state["mode"]) == (0, 0, "none")
        assert state["torque_nm"] > 0.5
