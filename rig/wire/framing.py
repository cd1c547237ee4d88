"""Frames that ScienceMode 2 and 4 have in common: start byte, escaped header, stuffed body, stop byte.

Each header byte stands behind an escape, xor 55. In the body the bytes `F0`, `0F` and `81` become an escape and the
byte xor 55. A frame's end is found by its length, since a header byte may itself look like `F0` or `0F`. After
damage the reader continues at the next `F0 81`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from stimrig.rig.errors import WireError

START, STOP, ESCAPE, KEY = 0xF0, 0x0F, 0x81, 0x55
SHORTEST_BODY_BYTES = 2

_STUFFED = {byte: bytes((ESCAPE, byte ^ KEY)) for byte in (START, STOP, ESCAPE)}


@dataclass(frozen=True, slots=True)
class Packet:
    """Content of one frame: packet number, command, data."""

    number: int
    command: int
    data: bytes = b""


def stuff(payload: bytes) -> bytes:
    """Payload with `F0`, `0F` and `81` each replaced by an escape and the byte xor 55."""
    return b"".join(_STUFFED.get(byte) or bytes((byte,)) for byte in payload)


def unstuff(stuffed: bytes) -> bytes:
    """The inverse of `stuff`.

    Raises
    ------
    WireError
        The last byte is an escape.
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


@dataclass(frozen=True, slots=True)
class Framing:
    """What differs between the protocols.

    Parameters
    ----------
    header_fields
        Number of header bytes, without their escapes.
    header
        Stuffed body -> header: length and CRC. Raises WireError if the body is too long.
    frame_length
        Header -> length of the whole frame, bytes.
    max_frame_bytes
        Longest frame that a reader waits for.
    pack, unpack
        Packet -> payload and back; `unpack` gets at least two bytes.
    """

    header_fields: int
    header: Callable[[bytes], bytes]
    frame_length: Callable[[bytes], int]
    max_frame_bytes: int
    pack: Callable[[Packet], bytes]
    unpack: Callable[[bytes], Packet]

    @property
    def header_bytes(self) -> int:
        """Start byte and header with its escapes."""
        return 1 + 2 * self.header_fields

    @property
    def min_frame_bytes(self) -> int:
        return self.header_bytes + SHORTEST_BODY_BYTES + 1

    def encode(self, packet: Packet) -> bytes:
        """The frame of a packet, as written to the line."""
        body = stuff(self.pack(packet))
        escaped = b"".join(bytes((ESCAPE, byte ^ KEY)) for byte in self.header(body))
        return bytes((START,)) + escaped + body + bytes((STOP,))

    def decode(self, frame: bytes) -> Packet:
        """The packet of one complete frame.

        Raises
        ------
        WireError
            Start, escapes, length, CRC or stop byte wrong, or no room for a command.
        """
        if len(frame) < self.min_frame_bytes or frame[0] != START or frame[-1] != STOP:
            raise WireError(f"not a frame: {frame.hex(' ')}")
        header, body = self.header_of(frame), frame[self.header_bytes : -1]
        if self.frame_length(header) != len(frame) or header != self.header(body):
            raise WireError(f"length or CRC wrong: {frame.hex(' ')}")
        payload = unstuff(body)
        if len(payload) < SHORTEST_BODY_BYTES:
            raise WireError(f"no command in frame: {frame.hex(' ')}")
        return self.unpack(payload)

    def header_of(self, frame: bytes | bytearray) -> bytes:
        """Header of a frame, or of its beginning. Raises WireError if an escape is missing."""
        head = bytes(frame[1 : self.header_bytes])
        if any(byte != ESCAPE for byte in head[::2]):
            raise WireError(f"escapes missing in header: {head.hex(' ')}")
        return bytes(byte ^ KEY for byte in head[1::2])

    def reader(self) -> FrameReader:
        return FrameReader(self)


class FrameReader:
    """Splits a stream of bytes into packets; damaged bytes are skipped and counted in `damaged`."""

    def __init__(self, framing: Framing) -> None:
        self._framing = framing
        self._buffer = bytearray()
        self.damaged = 0

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes from the line; yields each complete packet."""
        framing = self._framing
        self._buffer += data
        while self._to_start() and len(self._buffer) >= framing.header_bytes:
            try:
                length = framing.frame_length(framing.header_of(self._buffer))
                if not (framing.min_frame_bytes <= length <= framing.max_frame_bytes):
                    raise WireError(f"frame length {length}")
                if len(self._buffer) < length:
                    return
                packet = framing.decode(bytes(self._buffer[:length]))
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
            start = len(self._buffer) - self._buffer.endswith(bytes((START,)))
        if start:
            self.damaged += 1
            del self._buffer[:start]
        return bool(self._buffer)
