"""ScienceMode 2 and 4 as the devices see them: frames on the line to commands, and acks back.

A frame is F0, a header of a fixed length, the stuffed body, 0F. Each byte of the header goes as `81, byte ^ 55`.
"""

from __future__ import annotations

import binascii
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

START, STOP, ESCAPE, KEY = 0xF0, 0x0F, 0x81, 0x55
KEYED = bytes(byte ^ KEY for byte in range(256))
PATIENCE_S = 0.1


class Packet(NamedTuple):
    """One command or ack: its number, command and data."""

    number: int
    command: int
    data: bytes


def stuff(data: bytes) -> bytes:
    """Escape each byte that could be mistaken for a frame's border."""
    for byte in (ESCAPE, START, STOP):  # the escape first: those that it brings are not to be escaped
        data = data.replace(bytes((byte,)), bytes((ESCAPE, byte ^ KEY)))
    return data


def unstuff(data: bytes) -> bytes | None:
    """The reverse of `stuff`; None if an escape is the last byte."""
    plain = bytearray()
    begin = 0
    while (escape := data.find(ESCAPE, begin)) >= 0:
        if escape + 1 == len(data):
            return None
        plain += data[begin:escape]
        plain.append(data[escape + 1] ^ KEY)
        begin = escape + 2
    return bytes(plain + data[begin:])


def frame(header: bytes, body: bytes) -> bytes:
    """The frame of a plain header and a stuffed body."""
    escaped = bytearray((ESCAPE,)) * (2 * len(header))
    escaped[1::2] = header.translate(KEYED)
    return b"%c%b%b%c" % (START, escaped, body, STOP)


class ScienceMode(ABC):
    """Base of both versions of the protocol: byte stuffing, and finding frames in a stream of bytes.

    Bytes in, packets out; bytes that form no frame are skipped and counted in `corrupt_frames`.

    A piece of a frame after which nothing comes for `PATIENCE_S` is dropped. A client that dies in the middle of a
    frame therefore does not cost the next client its first command.
    """

    HEADER_BYTES: ClassVar[int]
    """Length of the header before its bytes are escaped."""

    def __init__(self) -> None:
        self.corrupt_frames = 0
        self._buffer = bytearray()
        self._last_byte_s = 0.0

    @staticmethod
    @abstractmethod
    def encode(packet: Packet) -> bytes:
        """The frame of one packet."""

    @abstractmethod
    def body_bytes(self, header: bytes) -> int | None:
        """Length of the stuffed body that this header announces, or None if it is impossible."""

    @abstractmethod
    def parse(self, header: bytes, stuffed: bytes) -> Packet | None:
        """The packet of a whole frame, or None if the frame is damaged."""

    def feed(self, data: bytes, time_s: float) -> list[Packet]:
        """All packets that are complete with `data`, which came at `time_s`."""
        if self._buffer and time_s - self._last_byte_s > PATIENCE_S:
            self._reject()
        self._last_byte_s = time_s
        self._buffer += data
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> Packet | None:
        buffer, body_at = self._buffer, 1 + 2 * self.HEADER_BYTES
        while (start := buffer.find(bytes((START, ESCAPE)))) >= 0:
            del buffer[:start]
            if len(buffer) < body_at:
                return None
            header = bytes(buffer[2:body_at:2].translate(KEYED))
            escapes = buffer[1:body_at:2].strip(bytes((ESCAPE,)))
            length = self.body_bytes(header) if not escapes else None
            if length is not None:
                stop_at = body_at + length
                if len(buffer) <= stop_at:
                    return None
                packet = self.parse(header, bytes(buffer[body_at:stop_at])) if buffer[stop_at] == STOP else None
                if packet is not None:
                    del buffer[: stop_at + 1]
                    return packet
            self._reject()
        del buffer[: len(buffer) - buffer.endswith(bytes((START,)))]
        return None

    def _reject(self) -> None:
        """Skip this start byte: another frame may begin inside what looked like one."""
        self.corrupt_frames += 1
        del self._buffer[:1]


def crc8(data: bytes) -> int:
    """CRC-8 with polynomial 07, from 0, most significant bit first."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07 if crc & 0x80 else crc << 1) & 0xFF
    return crc


class ScienceMode2(ScienceMode):
    """The header is a CRC and the length of the stuffed body, one byte each. The body is packet number, command, data.

    CRC-8 (poly 07, init 0, not reflected) is taken over the stuffed body. Frames with intact borders but a wrong CRC
    are kept until `take_damaged`.
    """

    SHORTEST_BODY = 2
    LONGEST_BODY = 2 * (2 + 8 * 4)
    """A Start of 8 channels, every byte stuffed."""
    HEADER_BYTES = 2

    def __init__(self) -> None:
        super().__init__()
        self._damaged: list[Packet] = []

    @staticmethod
    def encode(packet: Packet) -> bytes:
        """Number and command have a byte each."""
        body = stuff(bytes((packet.number, packet.command)) + packet.data)
        return frame(bytes((crc8(body), len(body))), body)

    def take_damaged(self) -> list[Packet]:
        """The damaged frames since the last call, as they read."""
        damaged, self._damaged = self._damaged, []
        return damaged

    def body_bytes(self, header: bytes) -> int | None:
        """From the body's length."""
        return header[1] if self.SHORTEST_BODY <= header[1] <= self.LONGEST_BODY else None

    def parse(self, header: bytes, stuffed: bytes) -> Packet | None:
        """None if the body is too short or the CRC is wrong."""
        body = unstuff(stuffed)
        if body is None or len(body) < self.SHORTEST_BODY:
            return None
        packet = Packet(body[0], body[1], body[2:])
        if header[0] != crc8(stuffed):
            self._damaged.append(packet)
            return None
        return packet


class ScienceMode4(ScienceMode):
    """The header is the length of the whole frame and a CRC, two bytes each.

    CRC-16/XMODEM is taken over the stuffed payload: u16 big endian, number << 10 | command, then data.
    """

    AROUND_BODY = 10
    """Start, escaped header and stop."""
    SHORTEST_FRAME = 12
    LONGEST_FRAME = 2 * (3 + 8 * (3 + 16 * 4)) + AROUND_BODY
    """A mid-level update of 8 channels with 16 points each, every byte stuffed."""
    HEADER_BYTES = 4

    @staticmethod
    def encode(packet: Packet) -> bytes:
        """The number has 6 bits, the command 10."""
        head = packet.number << 10 | packet.command
        payload = stuff(head.to_bytes(2, "big") + packet.data)
        length = len(payload) + ScienceMode4.AROUND_BODY
        return frame(length.to_bytes(2, "big") + binascii.crc_hqx(payload, 0).to_bytes(2, "big"), payload)

    def body_bytes(self, header: bytes) -> int | None:
        """From the length of the whole frame."""
        length = int.from_bytes(header[:2], "big")
        return length - self.AROUND_BODY if self.SHORTEST_FRAME <= length <= self.LONGEST_FRAME else None

    def parse(self, header: bytes, stuffed: bytes) -> Packet | None:
        """None if the CRC is wrong or the payload too short."""
        payload = unstuff(stuffed)
        if int.from_bytes(header[2:], "big") != binascii.crc_hqx(stuffed, 0) or payload is None or len(payload) < 2:
            return None
        head = int.from_bytes(payload[:2], "big")
        return Packet(head >> 10, head & 0x3FF, payload[2:])
