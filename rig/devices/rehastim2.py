"""Hasomed RehaStim 2 in ScienceMode 2, single pulses: one command per pulse, so without commands nothing is sent.

The channel list is never used, since the device would continue to play it for up to 1200 ms after the host's last
command. The device's own watchdog is still active: after 1200 ms without a command it closes the connection and offers
a new one. Only `feed` keeps it alive, which the rig calls after a health check: there is no keep-alive thread.

Numbers of several bytes come most significant first. The first byte of an ack is a signed result.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from pydantic import Field

from stimrig.rig.devices._line import SCIENCEMODE_2, LineSettings, LineStimulator, Packet
from stimrig.rig.errors import DeviceError, WireError
from stimrig.rig.limits import Admitted, Steps
from stimrig.rig.machine import Machine
from stimrig.rig.signals import Ack
from stimrig.rig.tasks import Signal

KIND = "stimulator"

FEED_S = 0.3
"""Rig seconds after the last command at which a keep-alive goes out, a quarter of the device's watchdog."""
OFFER_S = 1.5
"""Real seconds to wait for the device to offer a connection; it does so every 500 ms."""
VERSION = 1


class Command(IntEnum):
    """Commands used here; the device sends INIT, UNKNOWN and STIMULATION_ERROR without being asked."""

    INIT = 1
    INIT_ACK = 2
    UNKNOWN = 3
    WATCHDOG = 4
    GET_MODE = 10
    STOP = 34
    SINGLE_PULSE = 36
    STIMULATION_ERROR = 38


RESULTS = {
    0: "ok",
    -1: "transfer error",
    -2: "parameter error",
    -3: "wrong mode",
    -5: "protocol version refused",
    -8: "busy",
}
"""Result of an ack -> words."""

ERRORS = {-1: "emergency switch pressed", -2: "electrode error", -3: "stimulation module error"}
"""Words for the codes of StimulationError."""

START_MODE = 0
MODES = {0: "start mode, pulses on command only", 1: "channel list initialised", 2: "channel list running"}


def result_of(data: bytes) -> int:
    """Signed result at the head of an ack or error; a missing one counts as a transfer error."""
    return int.from_bytes(data[:1], "big", signed=True) if data else -1


def result_text(result: int) -> str:
    return RESULTS.get(result, f"error {result}")


def single_pulse(number: int, channel: int, pulse_width_us: int, current_ma: float) -> bytes:
    """Frame of one symmetric biphasic pulse, drawn by the device.

    `number`: of the packet, 0 … 255; `channel`: 0 … 7; `pulse_width_us`: of each phase, whole µs, 20 … 500;
    `current_ma`: 0 … 126 in steps of 2. Raises WireError: a value that the frame cannot carry: no pulse is better than
    another pulse.
    """
    if not (isinstance(pulse_width_us, int) and 20 <= pulse_width_us <= 500):
        raise WireError(f"pulse width {pulse_width_us} µs is not a whole number from 20 to 500")
    if not (0 <= current_ma <= 126 and current_ma % 2 == 0):
        raise WireError(f"current {current_ma} mA is not 0 to 126 in steps of 2")
    if not (0 <= channel <= 7):
        raise WireError(f"channel {channel}: 0 to 7")
    data = bytes((channel,)) + pulse_width_us.to_bytes(2, "big") + bytes((int(current_ma),))
    return SCIENCEMODE_2.encode(Packet(number, Command.SINGLE_PULSE, data))


class Settings(LineSettings):
    port: str = Field(description="serial port, e.g. /dev/serial/by-id/usb-FTDI_RehaStim2-if00-port0")
    channel: int = Field(1, ge=1, le=8, description="1 to 4 on side A, 5 to 8 on side B")
    reply_timeout_s: float = Field(0.3, gt=0, le=5, description="for commands other than pulses, real seconds")


class RehaStim2(LineStimulator[Settings]):
    """Driver of one RehaStim 2 on one serial port; see `rig.devices.Stimulator` for what the methods promise."""

    steps = Steps(pulse_width_us=1.0, current_ma=2.0, shortest_us=20.0)
    framing = SCIENCEMODE_2
    serial = {"baudrate": 460_800, "parity": "E"}  # noqa: RUF012

    def __init__(self, settings: Settings, machine: Machine) -> None:
        super().__init__(settings, machine)
        self._armed = False
        self._offered = Signal()
        self._offer: Packet | None = None

    async def open(self) -> dict[str, Any]:
        self._offer = None
        self._offered.clear()
        return await super().open()

    async def _identity(self) -> tuple[str, str]:
        return "", f"ScienceMode 2, protocol {VERSION}"

    async def arm(self) -> None:
        await self.stop()  # back to the start mode, whatever the mode was
        safe, state = await self.state()
        if not safe:
            raise DeviceError(f"{self._name}: cannot be armed, it is in {state}")
        self._armed = True

    def send(self, pulse: Admitted, latest_s: float) -> int:
        channel = self._settings.channel - 1
        return self._send(
            lambda number: single_pulse(number, channel, pulse.pulse_width_us, pulse.current_ma), latest_s
        )

    def feed(self) -> None:
        if self._armed and self._clock.now_s() - self._last_written_s >= FEED_S:
            self._send(self._frame(Command.WATCHDOG))

    async def stop(self) -> None:
        self._armed = False
        self._port.discard()
        result = result_of((await self._request(Command.STOP)).data)
        if result != 0:
            raise DeviceError(f"{self._name}: stop: {result_text(result)}")

    async def state(self) -> tuple[bool, str]:
        data = (await self._request(Command.GET_MODE)).data
        result = result_of(data)
        if result != 0 or len(data) < 2:
            raise DeviceError(f"{self._name} answered its mode with {result_text(result)}")
        return data[1] == START_MODE, MODES.get(data[1], f"mode {data[1]}")

    def close(self) -> None:
        self._armed = False
        super().close()

    async def _request(self, command: IntEnum, data: bytes = b"") -> Packet:
        """Ask; if the device has closed the connection, accept its next offer and ask once more."""
        try:
            return await super()._request(command, data)
        except DeviceError:
            if not await self._take_offer():
                raise
        return await super()._request(command, data)

    async def _take_offer(self) -> bool:
        """Accept a connection that the device offers; False if it offers none."""
        await self._tasks.sleep(OFFER_S, self._offered)
        offer, self._offer = self._offer, None
        self._offered.clear()
        if offer is None:
            return False
        accepted = offer.data[:1] == bytes((VERSION,))
        result = 0 if accepted else -5
        self._send(lambda _: SCIENCEMODE_2.encode(Packet(offer.number, Command.INIT_ACK, bytes((result & 0xFF,)))))
        if not accepted:
            raise DeviceError(f"{self._name}: it uses protocol {offer.data.hex()}, this driver 1")
        return True

    def _handle(self, packet: Packet, time_s: float) -> None:
        if packet.command == Command.SINGLE_PULSE + 1:
            result = result_of(packet.data)
            self._on_ack(Ack(packet.number, time_s, result_text(result) if result else None))
        elif packet.command == Command.STIMULATION_ERROR:
            error = result_of(packet.data)
            self._on_ack(Ack(-1, time_s, ERRORS.get(error, f"stimulation error {error}")))
        elif packet.command == Command.UNKNOWN:
            self._on_ack(Ack(packet.number, time_s, "unknown command"))
        elif packet.command == Command.INIT:
            self._offer = packet
            self._offered.set()
            if self._armed:
                self._on_ack(Ack(-1, time_s, "it restarted during a test (reset, power failure, or its watchdog)"))


create = RehaStim2
