"""ScienceMode 4 (Hasomed RehaMove P24): frames, commands and acks, low level.

Frame: `F0`, length and CRC each as two bytes behind an escape, the stuffed payload, `0F`. The payload starts with
packet number (6 bits) and command (10 bits). A frame's end is found by its length, since a stuffed header byte may
itself be `F0` or `0F`; after damage the stream is picked up again at the next `F0 81`.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from rig.errors import WireError

START, STOP, ESCAPE, KEY = 0xF0, 0x0F, 0x81, 0x55
HEADER_BYTES = 9
OVERHEAD_BYTES = 10
MAX_FRAME_BYTES = 128
"""Longer than any answer of the low level. Half a frame before a whole one can look like the head of a longer frame,
and would swallow what follows until its length is reached."""
NUMBERS = 64
INTERPHASE_US = 100

_STUFFED = {byte: bytes((ESCAPE, byte ^ KEY)) for byte in (START, STOP, ESCAPE)}


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
    """Words for a result byte, with the number where it is unknown."""
    return RESULTS.get(result, f"error {result}")


@dataclass(frozen=True, slots=True)
class Packet:
    """One payload: packet number 0 … 63, command, data."""

    number: int
    command: int
    data: bytes = b""


def stuff(payload: bytes) -> bytes:
    """Payload with `F0`, `0F` and `81` each replaced by an escape and the byte xor 55."""
    return b"".join(_STUFFED.get(byte) or bytes((byte,)) for byte in payload)


def unstuff(stuffed: bytes) -> bytes:
    """The payload back.

    Raises
    ------
    WireError
        An escape at the end, with nothing after it.
    """
    out = bytearray()
    rest = iter(stuffed)
    for byte in rest:
        if byte == ESCAPE:
            escaped = next(rest, None)
            if escaped is None:
                raise WireError("payload ends within an escape")
            byte = escaped ^ KEY
        out.append(byte)
    return bytes(out)


def encode(packet: Packet) -> bytes:
    """The frame of a packet, as written to the line."""
    stuffed = stuff(struct.pack(">H", packet.number << 10 | packet.command) + packet.data)
    length = len(stuffed) + OVERHEAD_BYTES
    header = struct.pack(">HH", length, binascii.crc_hqx(stuffed, 0))
    escaped = b"".join(bytes((ESCAPE, byte ^ KEY)) for byte in header)
    return bytes((START,)) + escaped + stuffed + bytes((STOP,))


def decode(frame: bytes) -> Packet:
    """The packet of one whole frame.

    Raises
    ------
    WireError
        Start, escapes, length, CRC or stop byte wrong, or no room for a command.
    """
    if len(frame) < OVERHEAD_BYTES + 2 or frame[0] != START or frame[-1] != STOP:
        raise WireError(f"no frame: {frame.hex(' ')}")
    length, crc = _header(frame)
    stuffed = frame[HEADER_BYTES:-1]
    if length != len(frame) or binascii.crc_hqx(stuffed, 0) != crc:
        raise WireError(f"length or CRC wrong: {frame.hex(' ')}")
    payload = unstuff(stuffed)
    if len(payload) < 2:
        raise WireError(f"no command in frame: {frame.hex(' ')}")
    head = struct.unpack_from(">H", payload)[0]
    return Packet(head >> 10, head & 0x3FF, payload[2:])


def _header(frame: bytes | bytearray) -> tuple[int, int]:
    if any(frame[i] != ESCAPE for i in (1, 3, 5, 7)):
        raise WireError(f"header's escapes missing: {bytes(frame[:HEADER_BYTES]).hex(' ')}")
    length, crc = struct.unpack(">HH", bytes(frame[i] ^ KEY for i in (2, 4, 6, 8)))
    return length, crc


class FrameReader:
    """Cuts a stream of bytes into packets; damaged bytes are skipped and counted in `damaged`."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.damaged = 0

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take what was read from the line and give each whole packet."""
        self._buffer += data
        while self._to_start():
            if len(self._buffer) < HEADER_BYTES:
                return
            try:
                length, _ = _header(self._buffer)
                if not (OVERHEAD_BYTES + 2 <= length <= MAX_FRAME_BYTES):
                    raise WireError(f"frame length {length}")
                if len(self._buffer) < length:
                    return
                packet = decode(bytes(self._buffer[:length]))
            except WireError:
                self.damaged += 1
                del self._buffer[:1]
                continue
            del self._buffer[:length]
            yield packet

    def _to_start(self) -> bool:
        """Drop everything before the next `F0 81`; True if the buffer now starts with (a part of) it."""
        start = self._buffer.find(bytes((START, ESCAPE)))
        if start < 0:
            keep = 1 if self._buffer.endswith(bytes((START,))) else 0
            start = len(self._buffer) - keep
        if start:
            self.damaged += 1
            del self._buffer[:start]
        return bool(self._buffer)


def ll_init(number: int, high_voltage: int = 0, measurement: int = 0) -> bytes:
    """Frame that initialises the low level."""
    return encode(Packet(number, Command.LL_INIT, bytes((measurement << 4 | high_voltage << 1,))))


def ll_stop(number: int) -> bytes:
    """Frame that leaves the low level; the device then stimulates no more."""
    return encode(Packet(number, Command.LL_STOP))


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
    return encode(Packet(number, Command.LL_CHANNEL_CONFIG, bytes((head,)) + body))


def query(number: int, command: Command) -> bytes:
    """Frame of a command that carries no data: device id, status, version."""
    return encode(Packet(number, command))


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
