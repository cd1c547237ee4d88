"""Hasomed RehaMove P24 in ScienceMode 4's low level: one command per pulse, so without commands nothing is sent.

The driver takes only width and current and makes the symmetric biphasic pulse itself, so a pulse is always balanced.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from stimrig.rig.devices import DeviceSettings
from stimrig.rig.devices._line import PacketLine
from stimrig.rig.errors import DeviceError
from stimrig.rig.limits import Admitted, Steps
from stimrig.rig.machine import Machine
from stimrig.rig.signals import Ack
from stimrig.rig.wire import sciencemode4 as wire
from stimrig.rig.wire.framing import Packet
from stimrig.rig.wire.sciencemode4 import Command

KIND = "stimulator"

BAUD_RATE = 3_000_000
NOT_INITIALISED = 7


class Settings(DeviceSettings):
    port: str = Field(description="serial port, e.g. /dev/serial/by-id/usb-HASOMED_P24-if00")
    channel: int = Field(1, ge=1, le=4, description="1 red, 2 blue, 3 black, 4 white")
    connector: int = Field(1, ge=1, le=2, description="1 yellow, 2 green")
    reply_timeout_s: float = Field(0.5, gt=0, le=5, description="for commands other than pulses, real seconds")


class P24:
    """Driver of one P24 on one serial port; see `stimrig.rig.devices.Stimulator` for what the methods promise."""

    steps = Steps(pulse_width_us=1.0, current_ma=0.5, shortest_us=1.0)

    def __init__(self, settings: Settings, machine: Machine) -> None:
        self._settings = settings
        port = machine.port(settings.port, baudrate=BAUD_RATE, stopbits=2, rtscts=True)
        self._line = PacketLine(machine, port, settings.port, wire.NUMBERS, wire.FRAMING.reader, self._take)
        self.listen, self.close = self._line.listen, self._line.close

    async def open(self) -> dict[str, Any]:
        await self._line.open()
        try:
            serial_number = wire.parse_device_id((await self._ask(Command.DEVICE_ID)).data)
            firmware = wire.parse_version((await self._ask(Command.EXTENDED_VERSION)).data)
            _, state = await self.state()
        except DeviceError:
            self.close()
            raise
        return {
            "device": "p24",
            "id": serial_number,
            "firmware": firmware,
            "port": self._settings.port,
            "channel": self._settings.channel,
            "state": state,
        }

    async def arm(self) -> None:
        await self._ask(Command.LL_INIT)

    def send(self, pulse: Admitted, latest_s: float) -> int:
        channel, connector = self._settings.channel - 1, self._settings.connector - 1
        return self._line.tell(
            lambda number: wire.ll_pulse(number, channel, pulse.pulse_width_us, pulse.current_ma, connector), latest_s
        )

    def feed(self) -> None:
        pass  # the low level has no watchdog: the device does nothing by itself

    async def stop(self) -> None:
        self._line.discard()
        await self._ask(
            Command.LL_STOP, fine=(0, NOT_INITIALISED)
        )  # a device that is not initialised has already stopped

    async def state(self) -> tuple[bool, str]:
        result, level, _ = wire.parse_status((await self._ask(Command.STIM_STATUS)).data)
        if result != 0:
            raise DeviceError(f"stimulator {self._settings.port} answered its state with {wire.result_text(result)}")
        return level == 0, wire.LEVELS.get(level, f"level {level}")

    async def _ask(self, command: Command, fine: tuple[int, ...] = (0,)) -> Packet:
        data = bytes((0,)) if command == Command.LL_INIT else b""
        name = command.name.lower().replace("_", " ")
        packet = await self._line.ask(
            lambda number: wire.FRAMING.encode(Packet(number, command, data)),
            name,
            command + 1,
            self._settings.reply_timeout_s,
        )
        result = packet.data[0] if packet.data else 1  # an answer without a result is none
        if result not in fine:
            raise DeviceError(f"stimulator {self._settings.port}: {name}: {wire.result_text(result)}")
        return packet

    def _take(self, packet: Packet, time_s: float) -> None:
        if packet.command == Command.LL_CHANNEL_CONFIG + 1:
            result = packet.data[0] if packet.data else 1
            self._line.on_ack(Ack(packet.number, time_s, wire.result_text(result) if result else None))
        elif packet.command in (Command.GENERAL_ERROR, Command.UNKNOWN_COMMAND):
            result = packet.data[0] if packet.data else 0
            words = wire.result_text(result) if result else "unknown command"
            self._line.on_ack(Ack(packet.number, time_s, words))


create = P24
