"""Hasomed RehaMove P24 in ScienceMode 4's low level: one command per pulse, so without commands nothing is sent.

The driver takes only width and current and makes the symmetric biphasic pulse itself, so a pulse is always balanced.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from pydantic import Field

from stimrig.rig.devices._line import SCIENCEMODE_4, LineSettings, LineStimulator, Packet, in_words
from stimrig.rig.errors import DeviceError, WireError
from stimrig.rig.limits import Admitted, Steps
from stimrig.rig.signals import Ack

KIND = "stimulator"

INTERPHASE_US = 100


class Command(IntEnum):
    """Commands used here."""

    LL_INIT = 0
    LL_CHANNEL_CONFIG = 2
    LL_STOP = 4
    DEVICE_ID = 52
    STIM_STATUS = 62
    GENERAL_ERROR = 66
    UNKNOWN_COMMAND = 67
    EXTENDED_VERSION = 68


RESULTS = {
    0: "ok",
    1: "transfer error",
    2: "parameter error",
    7: "not initialised",
    8: "high voltage error",
    10: "electrode error",
    11: "invalid command",
    16: "pulse timeout",
    28: "current too low",
}
"""Result byte of an ack -> words."""
NOT_INITIALISED = 7
LEVELS = {0: "not initialised", 1: "low level initialised", 2: "mid level initialised", 3: "mid level running"}
"""Stimulation status byte -> words."""


def result_text(result: int) -> str:
    return RESULTS.get(result, f"error {result}")


def ll_pulse(number: int, channel: int, pulse_width_us: int, current_ma: float, connector: int = 0) -> bytes:
    """Frame of one symmetric biphasic pulse: (w, +I), (100 µs, 0), (w, −I).

    `number`: of the packet, 0 … 63; `channel`, `connector`: counted from 0; `pulse_width_us`: of each phase, whole µs,
    1 … 4095; `current_ma`: 0 … 130 in steps of 0.5. Raises WireError: a value that the frame cannot carry: no pulse is
    better than another pulse.
    """
    half_ma = 2 * current_ma
    if not (isinstance(pulse_width_us, int) and 1 <= pulse_width_us <= 4095):
        raise WireError(f"pulse width {pulse_width_us} µs is not a whole number from 1 to 4095")
    if not (0 <= half_ma <= 260 and half_ma == int(half_ma)):
        raise WireError(f"current {current_ma} mA is not 0 to 130 in steps of 0.5")
    if not (0 <= channel <= 3 and 0 <= connector <= 1):
        raise WireError(f"channel {channel} on connector {connector}: 0 to 3 on 0 or 1")
    points = ((pulse_width_us, int(half_ma)), (INTERPHASE_US, 0), (pulse_width_us, -int(half_ma)))
    head = 0x80 | channel << 5 | connector << 4 | len(points) - 1
    body = b"".join(struct.pack(">I", width << 20 | half + 300 << 10) for width, half in points)
    return SCIENCEMODE_4.encode(Packet(number, Command.LL_CHANNEL_CONFIG, bytes((head,)) + body))


class Settings(LineSettings):
    port: str = Field(description="serial port, e.g. /dev/serial/by-id/usb-HASOMED_P24-if00")
    channel: int = Field(1, ge=1, le=4, description="1 red, 2 blue, 3 black, 4 white")
    connector: int = Field(1, ge=1, le=2, description="1 yellow, 2 green")
    reply_timeout_s: float = Field(0.5, gt=0, le=5, description="for commands other than pulses, real seconds")


class P24(LineStimulator[Settings]):
    """Driver of one P24 on one serial port; see `rig.devices.Stimulator` for what the methods promise."""

    steps = Steps(
        pulse_width_us=1.0, current_ma=0.5, shortest_us=10.0
    )  # the vendor's library: "every value < 10 = 10 µs"
    framing = SCIENCEMODE_4
    serial = {"baudrate": 3_000_000, "stopbits": 2, "rtscts": True}  # noqa: RUF012

    async def _identity(self) -> tuple[str, str]:
        serial_number = (await self._request(Command.DEVICE_ID)).data[1:11].decode("ascii", "replace").strip("\0 ")
        firmware = (await self._request(Command.EXTENDED_VERSION)).data[1:7]
        if len(firmware) < 6:  # too short to tell
            return serial_number, ""
        return serial_number, "{}.{}.{} (ScienceMode {}.{}.{})".format(*firmware)

    async def arm(self) -> None:
        await self._request(Command.LL_INIT, bytes((0,)))

    def send(self, pulse: Admitted, latest_s: float) -> int:
        channel, connector = self._settings.channel - 1, self._settings.connector - 1
        return self._send(
            lambda number: ll_pulse(number, channel, pulse.pulse_width_us, pulse.current_ma, connector), latest_s
        )

    def feed(self) -> None:
        pass  # the low level has no watchdog: the device does nothing by itself

    async def stop(self) -> None:
        self._port.discard()
        # a device that is not initialised has already stopped
        await self._request(Command.LL_STOP, fine=(0, NOT_INITIALISED))

    async def state(self) -> tuple[bool, str]:
        data = (await self._request(Command.STIM_STATUS)).data
        if len(data) < 3:
            raise WireError(f"{self._name}: status ack of {len(data)} bytes, expected 3")
        return data[1] == 0, LEVELS.get(data[1], f"level {data[1]}")

    async def _request(self, command: IntEnum, data: bytes = b"", fine: tuple[int, ...] = (0,)) -> Packet:
        packet = await super()._request(command, data)
        result = packet.data[0] if packet.data else 1  # an answer without a result is none
        if result not in fine:
            raise DeviceError(f"{self._name}: {in_words(command)}: {result_text(result)}")
        return packet

    def _handle(self, packet: Packet, time_s: float) -> None:
        if packet.command == Command.LL_CHANNEL_CONFIG + 1:
            result = packet.data[0] if packet.data else 1
            words = result_text(result) if result else self._of_another_output(packet.data)
            self._on_ack(Ack(packet.number, time_s, words))
        elif packet.command in (Command.GENERAL_ERROR, Command.UNKNOWN_COMMAND):
            result = packet.data[0] if packet.data else 0
            words = result_text(result) if result else "unknown command"
            self._on_ack(Ack(packet.number, time_s, words))

    def _of_another_output(self, data: bytes) -> str | None:
        """Return the error of an ack that names another output than the rig file's; None where it is that one."""
        settings = self._settings
        if len(data) < 2 or (data[1] & 0xF, data[1] >> 4) == (settings.channel - 1, settings.connector - 1):
            return None
        return "it acknowledged a pulse of an output that is not in use instead"


create = P24
