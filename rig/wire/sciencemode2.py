"""ScienceMode 2 (Hasomed RehaStim 2): frames, commands and acks.

Frame: `F0`, CRC-8 and length each as one byte behind an escape, the stuffed body, `0F`. The body is packet number,
command, data; numbers of several bytes come most significant first. CRC and length are those of the stuffed body.
An ack is the command + 1 with the same number; its first byte is a signed result.
"""

from __future__ import annotations

from enum import IntEnum

from stimrig.rig.errors import WireError
from stimrig.rig.wire.framing import Framing, Packet

OVERHEAD_BYTES = 6
MAX_BODY_BYTES = 0xFF
NUMBERS = 256
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
"""What a StimulationError says -> words."""

MODES = {0: "start mode, pulses on command only", 1: "channel list initialised", 2: "channel list running"}


def result_of(data: bytes) -> int:
    """Signed result at the head of an ack or error; a missing one counts as a transfer error."""
    return int.from_bytes(data[:1], "big", signed=True) if data else -1


def result_text(result: int) -> str:
    """Words for a result, with the number if it is unknown."""
    return RESULTS.get(result, f"error {result}")


def _crc_table() -> bytes:
    table = bytearray()
    for byte in range(256):
        for _ in range(8):
            byte = (byte << 1 ^ 0x07 if byte & 0x80 else byte << 1) & 0xFF
        table.append(byte)
    return bytes(table)


_CRC = _crc_table()


def crc8(data: bytes) -> int:
    """CRC-8, polynomial 07, from 0, not reflected."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def _header(body: bytes) -> bytes:
    if len(body) > MAX_BODY_BYTES:
        raise WireError(f"body of {len(body)} bytes, at most {MAX_BODY_BYTES}")
    return bytes((crc8(body), len(body)))


FRAMING = Framing(
    header_fields=2,
    header=_header,
    frame_length=lambda header: header[1] + OVERHEAD_BYTES,
    max_frame_bytes=MAX_BODY_BYTES + OVERHEAD_BYTES,
    pack=lambda packet: bytes((packet.number, packet.command)) + packet.data,
    unpack=lambda payload: Packet(payload[0], payload[1], payload[2:]),
)


def single_pulse(number: int, channel: int, pulse_width_us: int, current_ma: float) -> bytes:
    """Frame of one symmetric biphasic pulse, drawn by the device.

    Parameters
    ----------
    number
        Packet number, 0 … 255.
    channel
        0 … 7.
    pulse_width_us
        Width of each phase, whole µs, 20 … 500.
    current_ma
        0 … 126 mA in steps of 2.

    Raises
    ------
    WireError
        A value that the frame cannot carry: no pulse is better than another pulse.
    """
    if not (isinstance(pulse_width_us, int) and 20 <= pulse_width_us <= 500):
        raise WireError(f"pulse width {pulse_width_us} µs is not a whole number from 20 to 500")
    if not (0 <= current_ma <= 126 and current_ma % 2 == 0):
        raise WireError(f"current {current_ma} mA is not 0 to 126 in steps of 2")
    if not (0 <= channel <= 7):
        raise WireError(f"channel {channel}: 0 to 7")
    data = bytes((channel,)) + pulse_width_us.to_bytes(2, "big") + bytes((int(current_ma),))
    return FRAMING.encode(Packet(number, Command.SINGLE_PULSE, data))
