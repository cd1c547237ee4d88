"""ScienceMode 2 (Hasomed RehaStim 2): frames, commands and acks.

Frame: `F0`, CRC-8 and length each as one byte behind an escape, the stuffed body, `0F`. The body is packet number,
command, data; numbers of several bytes come most significant first. CRC and length are those of the stuffed body.
An ack is the command + 1 with the same number; its first byte is a signed result.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum

from rig.errors import WireError
from rig.wire.sciencemode4 import ESCAPE, KEY, START, STOP, Packet, stuff, unstuff

HEADER_BYTES = 5
OVERHEAD_BYTES = 6
SHORTEST_BODY_BYTES = 2
LONGEST_BODY_BYTES = 0xFF
NUMBERS = 256
BUSY = -8
VERSION = 1


class Command(IntEnum):
    """Commands of host and device; INIT, UNKNOWN and STIMULATION_ERROR come from the device of its own accord."""

    INIT = 1
    INIT_ACK = 2
    UNKNOWN = 3
    WATCHDOG = 4
    GET_MODE = 10
    INIT_CHANNEL_LIST = 30
    START = 32
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
    """Words for a result, with the number where it is unknown."""
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


def encode(packet: Packet) -> bytes:
    """The frame of a packet, as written to the line."""
    body = stuff(bytes((packet.number, packet.command)) + packet.data)
    return bytes((START, ESCAPE, crc8(body) ^ KEY, ESCAPE, len(body) ^ KEY)) + body + bytes((STOP,))


def decode(frame: bytes) -> Packet:
    """The packet of one whole frame.

    Raises
    ------
    WireError
        Start, escapes, length, CRC or stop byte wrong, or no room for a command.
    """
    if len(frame) < OVERHEAD_BYTES + SHORTEST_BODY_BYTES or frame[0] != START or frame[-1] != STOP:
        raise WireError(f"no frame: {frame.hex(' ')}")
    crc, length = _header(frame)
    stuffed = frame[HEADER_BYTES:-1]
    if length != len(stuffed) or crc8(stuffed) != crc:
        raise WireError(f"length or CRC wrong: {frame.hex(' ')}")
    body = unstuff(stuffed)
    if len(body) < SHORTEST_BODY_BYTES:
        raise WireError(f"no command in frame: {frame.hex(' ')}")
    return Packet(body[0], body[1], body[2:])


def _header(frame: bytes | bytearray) -> tuple[int, int]:
    if frame[1] != ESCAPE or frame[3] != ESCAPE:
        raise WireError(f"header's escapes missing: {bytes(frame[:HEADER_BYTES]).hex(' ')}")
    return frame[2] ^ KEY, frame[4] ^ KEY


class FrameReader:
    """Cuts a stream of bytes into packets; damaged bytes are skipped and counted in `damaged`."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.damaged = 0

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take what was read from the line and give each whole packet."""
        self._buffer += data
        while self._to_start() and len(self._buffer) >= HEADER_BYTES:
            try:
                _, length = _header(self._buffer)
                if not (SHORTEST_BODY_BYTES <= length <= LONGEST_BODY_BYTES):
                    raise WireError(f"frame length {length}")
                if len(self._buffer) < length + OVERHEAD_BYTES:
                    return
                packet = decode(bytes(self._buffer[: length + OVERHEAD_BYTES]))
            except WireError:
                self.damaged += 1
                del self._buffer[:1]
                continue
            del self._buffer[: length + OVERHEAD_BYTES]
            yield packet

    def _to_start(self) -> bool:
        """Drop everything before the next `F0 81`; True if the buffer now starts with (a part of) it."""
        start = self._buffer.find(bytes((START, ESCAPE)))
        if start < 0:
            start = len(self._buffer) - (1 if self._buffer.endswith(bytes((START,))) else 0)
        if start:
            self.damaged += 1
            del self._buffer[:start]
        return bool(self._buffer)


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
    return encode(Packet(number, Command.SINGLE_PULSE, data))
