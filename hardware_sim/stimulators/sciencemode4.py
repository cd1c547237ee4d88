"""ScienceMode 4 as the device sees it: frames on the line to commands, and acks back.

F0, then length (2 bytes) and CRC (2 bytes) each byte as `81, byte ^ 55`, then the stuffed payload, then 0F.
Length counts the whole frame. CRC-16/XMODEM over the stuffed payload. Payload: u16 big endian,
number << 10 | command, then data.
"""

from __future__ import annotations

import binascii
from typing import NamedTuple

START, STOP, ESCAPE, KEY = 0xF0, 0x0F, 0x81, 0x55
HEADER_BYTES = 9
SHORTEST_FRAME_BYTES = 12
LONGEST_FRAME_BYTES = 2 * (3 + 8 * (3 + 16 * 4)) + 10
"""A mid-level update of 8 channels with 16 points each, every byte stuffed."""


class Packet(NamedTuple):
    """One command or ack: its number (6 bits), command (10 bits) and data."""

    number: int
    command: int
    data: bytes


def stuff(data: bytes) -> bytes:
    """Escape each byte that could be taken for a frame's border."""
    stuffed = bytearray()
    for byte in data:
        if byte in (START, STOP, ESCAPE):
            stuffed += bytes((ESCAPE, byte ^ KEY))
        else:
            stuffed.append(byte)
    return bytes(stuffed)


def unstuff(data: bytes) -> bytes | None:
    """The reverse of `stuff`; None where an escape is the last byte."""
    plain = bytearray()
    pending = iter(data)
    for byte in pending:
        if byte == ESCAPE:
            escaped = next(pending, None)
            if escaped is None:
                return None
            plain.append(escaped ^ KEY)
        else:
            plain.append(byte)
    return bytes(plain)


def encode(packet: Packet) -> bytes:
    """The frame of one packet."""
    head = packet.number << 10 | packet.command
    payload = stuff(head.to_bytes(2, "big") + packet.data)
    crc = binascii.crc_hqx(payload, 0)
    length = len(payload) + HEADER_BYTES + 1
    header = bytearray((START,))
    for byte in length.to_bytes(2, "big") + crc.to_bytes(2, "big"):
        header += bytes((ESCAPE, byte ^ KEY))
    return bytes(header) + payload + bytes((STOP,))


class Decoder:
    """Bytes in, packets out; what is no frame is skipped and counted in `corrupt_frames`.

    A piece of a frame that stays alone for `patience_s` is given up, so that a client that died in the middle
    of a frame does not cost the next client its first command.
    """

    def __init__(self, patience_s: float = 0.1) -> None:
        self.corrupt_frames = 0
        self._patience_s = patience_s
        self._buffer = bytearray()
        self._last_byte_s = 0.0

    def feed(self, data: bytes, time_s: float) -> list[Packet]:
        """All packets that are complete with `data`, which came at `time_s`."""
        if self._buffer and time_s - self._last_byte_s > self._patience_s:
            self._reject()
        self._last_byte_s = time_s
        self._buffer += data
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> Packet | None:
        while True:
            start = self._buffer.find(bytes((START, ESCAPE)))
            if start < 0:
                keep = 1 if self._buffer[-1:] == bytes((START,)) else 0
                del self._buffer[: len(self._buffer) - keep]
                return None
            del self._buffer[:start]
            if len(self._buffer) < HEADER_BYTES:
                return None
            length = int.from_bytes(bytes((self._buffer[2] ^ KEY, self._buffer[4] ^ KEY)), "big")
            if not self._plausible(length):
                self._reject()
                continue
            if len(self._buffer) < length:
                return None
            packet = self._parse(bytes(self._buffer[:length]))
            if packet is None:
                self._reject()
                continue
            del self._buffer[:length]
            return packet

    def _plausible(self, length: int) -> bool:
        escapes = all(self._buffer[i] == ESCAPE for i in (1, 3, 5, 7))
        return escapes and SHORTEST_FRAME_BYTES <= length <= LONGEST_FRAME_BYTES

    @staticmethod
    def _parse(frame: bytes) -> Packet | None:
        crc = int.from_bytes(bytes((frame[6] ^ KEY, frame[8] ^ KEY)), "big")
        stuffed = frame[HEADER_BYTES:-1]
        if frame[-1] != STOP or crc != binascii.crc_hqx(stuffed, 0):
            return None
        payload = unstuff(stuffed)
        if payload is None or len(payload) < 2:
            return None
        head = int.from_bytes(payload[:2], "big")
        return Packet(head >> 10, head & 0x3FF, payload[2:])

    def _reject(self) -> None:
        """Skip this start byte: a frame may begin inside what looked like one."""
        self.corrupt_frames += 1
        del self._buffer[:1]
