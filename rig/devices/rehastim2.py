"""Hasomed RehaStim 2 in ScienceMode 2, single pulses: one command per pulse, so without commands nothing is sent.

The channel list is never used, since the device would continue to play it for up to 1200 ms after the host's last
command. The device's own watchdog is still active: after 1200 ms without a command it closes the connection and offers
a new one. Only `feed` keeps it alive, which the rig calls after a health check: there is no keep-alive thread.
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
from stimrig.rig.tasks import Signal
from stimrig.rig.wire import sciencemode2 as wire
from stimrig.rig.wire.framing import Packet
from stimrig.rig.wire.sciencemode2 import Command

KIND = "stimulator"

BAUD_RATE = 460_800
FEED_S = 0.3
"""Rig seconds after the last command at which a keep-alive goes out, a quarter of the device's watchdog."""
OFFER_S = 1.5
"""Real seconds to wait for the device to offer a connection; it does so every 500 ms."""
START_MODE = 0


class Settings(DeviceSettings):
    port: str = Field(description="serial port, e.g. /dev/serial/by-id/usb-FTDI_RehaStim2-if00-port0")
    channel: int = Field(1, ge=1, le=8, description="1 to 4 on side A, 5 to 8 on side B")
    reply_timeout_s: float = Field(0.3, gt=0, le=5, description="for commands other than pulses, real seconds")


class RehaStim2:
    """Driver of one RehaStim 2 on one serial port; see `rig.devices.Stimulator` for what the methods promise."""

    steps = Steps(pulse_width_us=1.0, current_ma=2.0, shortest_us=20.0)

    def __init__(self, settings: Settings, machine: Machine) -> None:
        self._settings = settings
        self._tasks, self._clock = machine.tasks, machine.tasks.clock
        port = machine.port(settings.port, baudrate=BAUD_RATE, parity="E")
        self._line = PacketLine(machine, port, settings.port, wire.NUMBERS, wire.FRAMING.reader, self._take)
        self._armed = False
        self._offered = Signal()
        self._offer: Packet | None = None
        self.listen = self._line.listen

    async def open(self) -> dict[str, Any]:
        self._offer = None
        self._offered.clear()
        await self._line.open()
        try:
            _, state = await self.state()
        except DeviceError:
            self.close()
            raise
        return {
            "device": "rehastim2",
            "id": "",
            "firmware": f"ScienceMode 2, protocol {wire.VERSION}",
            "port": self._settings.port,
            "channel": self._settings.channel,
            "state": state,
        }

    async def arm(self) -> None:
        await self.stop()  # back to the start mode, whatever the mode was
        safe, state = await self.state()
        if not safe:
            raise DeviceError(f"stimulator {self._settings.port}: cannot be armed, it is in {state}")
        self._armed = True

    def send(self, pulse: Admitted, latest_s: float) -> int:
        channel = self._settings.channel - 1
        return self._line.tell(
            lambda number: wire.single_pulse(number, channel, pulse.pulse_width_us, pulse.current_ma), latest_s
        )

    def feed(self) -> None:
        if self._armed and self._clock.now_s() - self._line.last_written_s >= FEED_S:
            self._line.tell(lambda number: wire.FRAMING.encode(Packet(number, Command.WATCHDOG)))

    async def stop(self) -> None:
        self._armed = False
        self._line.discard()
        result = wire.result_of((await self._ask(Command.STOP)).data)
        if result != 0:
            raise DeviceError(f"stimulator {self._settings.port}: stop: {wire.result_text(result)}")

    async def state(self) -> tuple[bool, str]:
        data = (await self._ask(Command.GET_MODE)).data
        result = wire.result_of(data)
        if result != 0 or len(data) < 2:
            raise DeviceError(f"stimulator {self._settings.port} answered its mode with {wire.result_text(result)}")
        return data[1] == START_MODE, wire.MODES.get(data[1], f"mode {data[1]}")

    def close(self) -> None:
        self._armed = False
        self._line.close()

    async def _ask(self, command: Command) -> Packet:
        """Ask; if the device has closed the connection, accept its next offer and ask once more."""
        try:
            return await self._ask_once(command)
        except DeviceError:
            if not await self._take_offer():
                raise
        return await self._ask_once(command)

    async def _ask_once(self, command: Command) -> Packet:
        name = command.name.lower().replace("_", " ")
        timeout_s = self._settings.reply_timeout_s
        make = lambda number: wire.FRAMING.encode(Packet(number, command))  # noqa: E731
        return await self._line.ask(make, name, command + 1, timeout_s)

    async def _take_offer(self) -> bool:
        """Accept a connection that the device offers; False if it offers none."""
        await self._tasks.sleep(OFFER_S, self._offered)
        offer, self._offer = self._offer, None
        self._offered.clear()
        if offer is None:
            return False
        accepted = offer.data[:1] == bytes((wire.VERSION,))
        result = 0 if accepted else -5
        self._line.tell(lambda _: wire.FRAMING.encode(Packet(offer.number, Command.INIT_ACK, bytes((result & 0xFF,)))))
        if not accepted:
            raise DeviceError(f"stimulator {self._settings.port}: it uses protocol {offer.data.hex()}, this driver 1")
        return True

    def _take(self, packet: Packet, time_s: float) -> None:
        if packet.command == Command.SINGLE_PULSE + 1:
            result = wire.result_of(packet.data)
            self._line.on_ack(Ack(packet.number, time_s, wire.result_text(result) if result else None))
        elif packet.command == Command.STIMULATION_ERROR:
            error = wire.result_of(packet.data)
            self._line.on_ack(Ack(-1, time_s, wire.ERRORS.get(error, f"stimulation error {error}")))
        elif packet.command == Command.UNKNOWN:
            self._line.on_ack(Ack(packet.number, time_s, "unknown command"))
        elif packet.command == Command.INIT:
            self._take_init(packet, time_s)

    def _take_init(self, packet: Packet, time_s: float) -> None:
        self._offer = packet
        self._offered.set()
        if self._armed:
            self._line.on_ack(Ack(-1, time_s, "it restarted during a test (reset, power failure, or its watchdog)"))


create = RehaStim2
