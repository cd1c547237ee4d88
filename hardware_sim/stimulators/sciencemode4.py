"""ScienceMode 4 as the device sees it: frames on the line to commands, and acks back.

The header is the length of the whole frame and a CRC, two bytes each. CRC-16/XMODEM is taken over the stuffed payload.
Payload: u16 big endian, number << 10 | command, then data.
"""

from __future__ import annotations

import binascii

from stimrig.hardware_sim.stimulators.framing import FrameDecoder, Packet, frame, stuff, unstuff

AROUND_BODY_BYTES = 10
"""Start, escaped header and stop."""
SHORTEST_FRAME_BYTES = 12
LONGEST_FRAME_BYTES = 2 * (3 + 8 * (3 + 16 * 4)) + AROUND_BODY_BYTES
"""A mid-level update of 8 channels with 16 points each, every byte stuffed."""


def encode(packet: Packet) -> bytes:
    """The frame of one packet; its number has 6 bits, its command 10."""
    head = packet.number << 10 | packet.command
    payload = stuff(head.to_bytes(2, "big") + packet.data)
    length = len(payload) + AROUND_BODY_BYTES
    return frame(length.to_bytes(2, "big") + binascii.crc_hqx(payload, 0).to_bytes(2, "big"), payload)


class Decoder(FrameDecoder):
    """Bytes in, packets out."""

    HEADER_BYTES = 4

    def body_bytes(self, header: bytes) -> int | None:
        """From the length of the whole frame."""
        length = int.from_bytes(header[:2], "big")
        return length - AROUND_BODY_BYTES if SHORTEST_FRAME_BYTES <= length <= LONGEST_FRAME_BYTES else None

    def parse(self, header: bytes, stuffed: bytes) -> Packet | None:
        """None if the CRC is wrong or the payload too short."""
        payload = unstuff(stuffed)
        if int.from_bytes(header[2:], "big") != binascii.crc_hqx(stuffed, 0) or payload is None or len(payload) < 2:
            return None
        head = int.from_bytes(payload[:2], "big")
        return Packet(head >> 10, head & 0x3FF, payload[2:])
