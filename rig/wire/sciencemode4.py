"""ScienceMode 4 (Hasomed RehaMove P24): frames, commands and acks, low level.

Frame: `F0`, length and CRC each as two bytes behind an escape, the stuffed payload, `0F`. The payload starts with
packet number (6 bits) and command (10 bits).
"""

from __future__ import annotations

import binascii
import struct
from enum import IntEnum

from stimrig.rig.errors import WireError
from stimrig.rig.wire.framing import Framing, Packet

OVERHEAD_BYTES = 10
MAX_FRAME_BYTES = 128
"""Longer than any answer of the low level. Part of a damaged frame may look like the start of a longer frame, and the
reader would then wait for that length and lose the frames in between."""
NUMBERS = 64
INTERPHASE_US = 100


class Command(IntEnum):
    """Commands used here; an ack is the command + 1."""

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

LEVELS = {0: "not initialised", 1: "low level initialised", 2: "mid level initialised", 3: "mid level running"}
"""Stimulation status byte -> words."""


def result_text(result: int) -> str:
    """Words for a result byte, with the number if it is unknown."""
    return RESULTS.get(result, f"error {result}")


def _unpack(payload: bytes) -> Packet:
    head = int.from_bytes(payload[:2], "big")
    return Packet(head >> 10, head & 0x3FF, payload[2:])


FRAMING = Framing(
    header_fields=4,
    header=lambda body: struct.pack(">HH", len(body) + OVERHEAD_BYTES, binascii.crc_hqx(body, 0)),
    frame_length=lambda header: int.from_bytes(header[:2], "big"),
    max_frame_bytes=MAX_FRAME_BYTES,
    pack=lambda packet: struct.pack(">H", packet.number << 10 | packet.command) + packet.data,
    unpack=_unpack,
)


def ll_pulse(number: int, channel: int, pulse_width_us: int, current_ma: float, connector: int = 0) -> bytes:
    """Frame of one symmetric biphasic pulse: (w, +I), (100 µs, 0), (w, −I).

    Parameters
    ----------
    number
        Packet number, 0 … 63.
    channel, connector
        Counted from 0.
    pulse_width_us
        Width of each phase, whole µs, 1 … 4095.
    current_ma
        0 … 130 mA in steps of 0.5.

    Raises
    ------
    WireError
        A value that the frame cannot carry: no pulse is better than another pulse.
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
    return FRAMING.encode(Packet(number, Command.LL_CHANNEL_CONFIG, bytes((head,)) + body))


def parse_status(data: bytes) -> tuple[int, int, int]:
    """(result, level, high voltage code) of a status ack.

    Raises
    ------
    WireError
        Too short.
    """
    if len(data) < 3:
        raise WireError(f"status ack of {len(data)} bytes, expected 3")
    return data[0], data[1], data[2]


def parse_device_id(data: bytes) -> str:
    """Serial number of a device id ack: ten characters after the result."""
    return data[1:11].decode("ascii", "replace").strip("\0 ")


def parse_version(data: bytes) -> str:
    """`firmware (ScienceMode version)` of an extended version ack, '' where it is too short to tell."""
    if len(data) < 7:
        return ""
    return f"{data[1]}.{data[2]}.{data[3]} (ScienceMode {data[4]}.{data[5]}.{data[6]})"
