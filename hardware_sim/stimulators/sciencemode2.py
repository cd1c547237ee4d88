"""ScienceMode 2 as the device sees it: frames on the line to commands, and acks back.

F0, then CRC and length each as `81, byte ^ 55`, then the stuffed body, then 0F. The body is packet number,
command, data. Length counts the stuffed body; CRC-8 (poly 07, init 0, not reflected) is taken over it.
"""

from __future__ import annotations

from typing import NamedTuple

from hardware_sim.stimulators.sciencemode4 import ESCAPE, KEY, START, STOP, stuff, unstuff

HEADER_BYTES = 5
SHORTEST_BODY_BYTES = 2
LONGEST_BODY_BYTES = 2 * (2 + 8 * 4)
"""A Start of 8 channels, every byte stuffed."""
POLYNOMIAL = 0x07


class Packet(NamedTuple):
    """One command or ack: its number and command, a byte each, and data."""

    number: int
    command: int
    data: bytes


def crc8(data: bytes) -> int:
    """CRC-8 with polynomial 07, from 0, most significant bit first."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
    return crc


def encode(packet: Packet) -> bytes:
    """The frame of one packet."""
    body = stuff(bytes((packet.number, packet.command)) + packet.data)
    return bytes((START, ESCAPE, crc8(body) ^ KEY, ESCAPE, len(body) ^ KEY)) + body + bytes((STOP,))


class Decoder:
    """Bytes in, packets out; what is no frame is skipped and counted in `corrupt_frames`.

    A frame whose borders hold but whose CRC does not is also kept in `damaged`, as it reads, until taken. A piece
    of a frame that stays alone for `patience_s` is given up, so that a client that died in the middle of a frame
    does not cost the next client its first command.
    """

    def __init__(self, patience_s: float = 0.1) -> None:
        self.corrupt_frames = 0
        self._damaged: list[Packet] = []
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

    def take_damaged(self) -> list[Packet]:
        """The damaged frames since the last call."""
        damaged, self._damaged = self._damaged, []
        return damaged

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
            length = self._buffer[4] ^ KEY
            if self._buffer[3] != ESCAPE or not SHORTEST_BODY_BYTES <= length <= LONGEST_BODY_BYTES:
                self._reject()
                continue
            end = HEADER_BYTES + length + 1
            if len(self._buffer) < end:
                return None
            packet = self._parse(bytes(self._buffer[:end]))
            if packet is None:
                self._reject()
                continue
            del self._buffer[:end]
            return packet

    def _parse(self, frame: bytes) -> Packet | None:
        stuffed = frame[HEADER_BYTES:-1]
        body = unstuff(stuffed)
        if frame[-1] != STOP or body is None or len(body) < SHORTEST_BODY_BYTES:
            return None
        packet = Packet(body[0], body[1], body[2:])
        if frame[2] ^ KEY != crc8(stuffed):
            self._damaged.append(packet)
            return None
        return packet

    def _reject(self) -> None:
        """Skip this start byte: a frame may begin inside what looked like one."""
        self.corrupt_frames += 1
        del self._buffer[:1]
