"""The codec against frames that independent, published clients made (the vectors in the devices' notes)."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_sim.stimulators.framing import Packet, stuff, unstuff
from hardware_sim.stimulators.sciencemode4 import Decoder, encode

FRAMES = {
    "GetStimStatus": ("f0 81 55 81 59 81 4e 81 0c 04 3e 0f", Packet(1, 62, b"")),
    "LLInit": ("f0 81 55 81 58 81 16 81 36 10 00 00 0f", Packet(4, 0, b"\x00")),
    "LLConfig 250 us 20 mA": (
        "f0 81 55 81 4e 81 cd 81 ae 14 02 82 81 5a a5 50 00 06 44 b0 00 81 5a a4 10 00 0f",
        Packet(5, 2, bytes.fromhex("82 0fa55000 0644b000 0fa41000")),
    ),
    "LLConfig 300 us 20.5 mA": (
        "f0 81 55 81 4c 81 e5 81 94 18 02 82 12 c5 54 00 06 44 b0 00 12 c4 0c 00 0f",
        Packet(6, 2, bytes.fromhex("82 12c55400 0644b000 12c40c00")),
    ),
    "LLConfig 240 us 20 mA": (
        "f0 81 55 81 4e 81 0f 81 21 3c 02 82 81 5a 05 50 00 06 44 b0 00 81 5a 04 10 00 0f",
        Packet(15, 2, bytes.fromhex("82 0f055000 0644b000 0f041000")),
    ),
    "LLStop": ("f0 81 55 81 59 81 13 81 37 20 04 0f", Packet(8, 4, b"")),
    "MLUpdate 25 ms": (
        "f0 81 55 81 4b 81 22 81 bc 28 20 01 20 00 64 81 5a a5 50 00 06 44 b0 00 81 5a a4 10 00 0f",
        Packet(10, 32, bytes.fromhex("01 20 0064 0fa55000 0644b000 0fa41000")),
    ),
    "MLStop": ("f0 81 55 81 59 81 54 81 e0 30 22 0f", Packet(12, 34, b"")),
    "LLInitAck": ("f0 81 55 81 58 81 25 81 07 10 01 00 0f", Packet(4, 1, b"\x00")),
    "LLConfigAck": ("f0 81 55 81 5a 81 43 81 d5 14 03 00 00 00 0f", Packet(5, 3, bytes(3))),
    "LLConfigAck electrode": ("f0 81 55 81 5a 81 84 81 14 14 03 0a 00 00 0f", Packet(5, 3, b"\x0a\x00\x00")),
}
VECTORS = [pytest.param(bytes.fromhex(text), packet, id=name) for name, (text, packet) in FRAMES.items()]
packets = st.builds(Packet, st.integers(0, 63), st.integers(0, 1023), st.binary(max_size=80))


@pytest.mark.parametrize(("frame", "packet"), VECTORS)
def test_vectors_both_ways(frame: bytes, packet: Packet) -> None:
    assert encode(packet) == frame
    assert Decoder().feed(frame, 0.0) == [packet]


@pytest.mark.parametrize(("frame", "packet"), VECTORS)
def test_byte_by_byte_and_after_noise(frame: bytes, packet: Packet) -> None:
    decoder = Decoder()
    found = [p for byte in b"\x0f\xf0\x81\x00\xf0" + frame for p in decoder.feed(bytes([byte]), 0.0)]
    assert found == [packet]


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


@given(packets, st.integers(0, 10**6), st.integers(1, 255))
@settings(max_examples=300, deadline=None)
def test_one_wrong_byte_is_never_taken_and_the_next_frame_is(packet: Packet, place: int, change: int) -> None:
    frame = bytearray(encode(packet))
    frame[place % len(frame)] ^= change
    decoder = Decoder()
    assert decoder.feed(bytes(frame), 0.0) == []
    assert decoder.feed(encode(Packet(7, 62, b"")), 1.0) == [Packet(7, 62, b"")]


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_stuffing_is_reversible_and_hides_borders(data: bytes) -> None:
    stuffed = stuff(data)
    assert unstuff(stuffed) == data
    assert not {0xF0, 0x0F} & set(stuffed)


@given(st.binary(max_size=600))
@settings(max_examples=200, deadline=None)
def test_garbage_raises_nothing(data: bytes) -> None:
    decoder = Decoder()
    decoder.feed(data, 0.0)
    assert decoder.feed(encode(Packet(1, 4, b"")), 1.0)[-1:] == [Packet(1, 4, b"")]


def test_half_a_frame_of_a_dead_client_does_not_swallow_the_next() -> None:
    decoder, frame = Decoder(patience_s=0.1), encode(Packet(3, 2, bytes(60)))
    assert decoder.feed(frame[:30], 0.0) == []
    assert decoder.feed(encode(Packet(4, 62, b"")), 0.5) == [Packet(4, 62, b"")]
    assert decoder.corrupt_frames == 1
