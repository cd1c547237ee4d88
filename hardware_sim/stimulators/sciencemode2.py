"""ScienceMode 2 as the device sees it: frames on the line to commands, and acks back.

The header is a CRC and the length of the stuffed body, one byte each. CRC-8 (poly 07, init 0, not reflected) is taken
over the stuffed body. The body is packet number, command, data.
"""

from __future__ import annotations

from stimrig.hardware_sim.stimulators.framing import FrameDecoder, Packet, frame, stuff, unstuff

SHORTEST_BODY_BYTES = 2
LONGEST_BODY_BYTES = 2 * (2 + 8 * 4)
"""A Start of 8 channels, every byte stuffed."""
POLYNOMIAL = 0x07


def crc8(data: bytes) -> int:
    """CRC-8 with polynomial 07, from 0, most significant bit first."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
    return crc


def encode(packet: Packet) -> bytes:
    """The frame of one packet; its number and command have a byte each."""
    body = stuff(bytes((packet.number, packet.command)) + packet.data)
    return frame(bytes((crc8(body), len(body))), body)


class Decoder(FrameDecoder):
    """Bytes in, packets out; frames with intact borders but a wrong CRC are kept until `take_damaged`."""

    HEADER_BYTES = 2

    def __init__(self) -> None:
        super().__init__()
        self._damaged: list[Packet] = []

    def take_damaged(self) -> list[Packet]:
        """The damaged frames since the last call, as they read."""
        damaged, self._damaged = self._damaged, []
        return damaged

    def body_bytes(self, header: bytes) -> int | None:
        """From the body's length."""
        return header[1] if SHORTEST_BODY_BYTES <= header[1] <= LONGEST_BODY_BYTES else None

    def parse(self, header: bytes, stuffed: bytes) -> Packet | None:
        """None if the body is too short or the CRC is wrong."""
        body = unstuff(stuffed)
        if body is None or len(body) < SHORTEST_BODY_BYTES:
            return None
        packet = Packet(body[0], body[1], body[2:])
        if header[0] != crc8(stuffed):
            self._damaged.append(packet)
            return None
        return packet
