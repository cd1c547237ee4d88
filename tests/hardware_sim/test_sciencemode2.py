"""ScienceMode 2's codec against frames that an independent, published client made (the devices' notes)."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_sim.stimulators.framing import Packet
from hardware_sim.stimulators.sciencemode2 import Decoder, crc8, encode

FRAMES = {
    "InitAck": ("f0 81 7f 81 56 00 02 00 0f", Packet(0, 2, b"\x00")),
    "Watchdog": ("f0 81 5c 81 57 01 04 0f", Packet(1, 4, b"")),
    "InitList ch1 8 ms 25 ms": (
        "f0 81 35 81 5c 03 1e 00 01 00 0d 00 30 00 0f",
        Packet(3, 30, bytes.fromhex("00 01 00 0d 0030 00")),
    ),
    "Start 250 us 20 mA": ("f0 81 6f 81 53 04 20 00 00 fa 14 0f", Packet(4, 32, bytes.fromhex("00 00fa 14"))),
    "Start 271 us 20 mA": ("f0 81 50 81 52 05 20 00 01 81 5a 14 0f", Packet(5, 32, bytes.fromhex("00 010f 14"))),
    "Start 129 us 15 mA": ("f0 81 0c 81 5d 07 20 00 00 81 d4 81 5a 0f", Packet(7, 32, bytes.fromhex("00 0081 0f"))),
    "Stop": ("f0 81 13 81 57 08 22 0f", Packet(8, 34, b"")),
    "SinglePulse 300 us 25 mA": ("f0 81 ae 81 53 09 24 00 01 2c 19 0f", Packet(9, 36, bytes.fromhex("00 012c 19"))),
    "Watchdog 15": ("f0 81 a7 81 56 81 5a 04 0f", Packet(15, 4, b"")),
    "GetMode": ("f0 81 49 81 57 02 0a 0f", Packet(2, 10, b"")),
    "Init": ("f0 81 47 81 56 00 01 01 0f", Packet(0, 1, b"\x01")),
    "StartAck": ("f0 81 45 81 56 04 21 00 0f", Packet(4, 33, b"\x00")),
    "StimulationError electrode": ("f0 81 1a 81 56 01 26 fe 0f", Packet(1, 38, b"\xfe")),
}
VECTORS = [pytest.param(bytes.fromhex(text), packet, id=name) for name, (text, packet) in FRAMES.items()]
packets = st.builds(Packet, st.integers(0, 255), st.integers(0, 255), st.binary(max_size=32))


@pytest.mark.parametrize(("frame", "packet"), VECTORS)
def test_vectors_both_ways(frame: bytes, packet: Packet) -> None:
    assert encode(packet) == frame
    assert Decoder().feed(frame, 0.0) == [packet]


@pytest.mark.parametrize(("frame", "packet"), VECTORS)
def test_byte_by_byte_and_after_noise(frame: bytes, packet: Packet) -> None:
    decoder = Decoder()
    found = [p for byte in b"\x0f\xf0\x81\x00\x00\xf0" + frame for p in decoder.feed(bytes([byte]), 0.0)]
    assert found == [packet]


def test_the_crcs_own_check_value() -> None:
    assert crc8(b"123456789") == 0xF4  # CRC-8/SMBUS in the catalogue of parametrised CRCs


@given(st.lists(packets, max_size=5), st.randoms(use_true_random=False))
@settings(max_examples=100, deadline=None)
def test_any_packets_in_any_pieces(sent: list[Packet], cut) -> None:
    line = b"".join(map(encode, sent))
    decoder, found = Decoder(), []
    while line:
        size = cut.randint(1, 40)
        found += decoder.feed(line[:size], 0.0)
        line = line[size:]
    assert found == sent
    assert decoder.corrupt_frames == 0


@given(packets, st.integers(0, 10**6), st.integers(0, 7))
@settings(max_examples=300, deadline=None)
def test_one_wrong_bit_is_never_taken_and_the_next_frame_is(packet: Packet, place: int, bit: int) -> None:
    frame = bytearray(encode(packet))
    frame[place % len(frame)] ^= 1 << bit
    decoder = Decoder()
    assert decoder.feed(bytes(frame), 0.0) == []
    assert decoder.feed(encode(Packet(7, 10, b"")), 1.0) == [Packet(7, 10, b"")]


def test_a_damaged_frame_is_kept_as_it_reads() -> None:
    decoder, frame = Decoder(), bytearray(encode(Packet(4, 32, bytes.fromhex("0000fa14"))))
    frame[-2] ^= 0x02
    assert decoder.feed(bytes(frame), 0.0) == []
    assert decoder.take_damaged() == [Packet(4, 32, bytes.fromhex("0000fa16"))]
    assert decoder.take_damaged() == []


@given(st.binary(max_size=600))
@settings(max_examples=200, deadline=None)
def test_garbage_raises_nothing(data: bytes) -> None:
    decoder = Decoder()
    decoder.feed(data, 0.0)
    assert decoder.feed(encode(Packet(1, 4, b"")), 1.0)[-1:] == [Packet(1, 4, b"")]


def test_half_a_frame_of_a_dead_client_does_not_swallow_the_next() -> None:
    decoder, frame = Decoder(patience_s=0.1), encode(Packet(3, 32, bytes(32)))
    assert decoder.feed(frame[:20], 0.0) == []
    assert decoder.feed(encode(Packet(4, 10, b"")), 0.5) == [Packet(4, 10, b"")]
    assert decoder.corrupt_frames == 1
