"""Both codecs against frames that independent, published clients made (the vectors in the devices' notes)."""

from __future__ import annotations

from types import ModuleType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_sim.stimulators import sciencemode2, sciencemode4
from hardware_sim.stimulators.framing import Packet, stuff, unstuff

FRAMES_2 = {
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
FRAMES_4 = {
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
VECTORS = [
    pytest.param(codec, bytes.fromhex(text), packet, id=name)
    for codec, frames in ((sciencemode2, FRAMES_2), (sciencemode4, FRAMES_4))
    for name, (text, packet) in frames.items()
]
LIMITS = {sciencemode2: (255, 255, 32), sciencemode4: (63, 1023, 80)}
"""Largest packet number and command, and most bytes of data that are tried."""
CODECS = pytest.mark.parametrize("codec", LIMITS, ids=["2", "4"])
NEXT = Packet(1, 4, b"")


def packet_of(codec: ModuleType) -> st.SearchStrategy[Packet]:
    number, command, size = LIMITS[codec]
    return st.builds(Packet, st.integers(0, number), st.integers(0, command), st.binary(max_size=size))


@pytest.mark.parametrize(("codec", "frame", "packet"), VECTORS)
def test_vectors_both_ways(codec: ModuleType, frame: bytes, packet: Packet) -> None:
    assert codec.encode(packet) == frame
    assert codec.Decoder().feed(frame, 0.0) == [packet]


@pytest.mark.parametrize(("codec", "frame", "packet"), VECTORS)
def test_byte_by_byte_and_after_noise(codec: ModuleType, frame: bytes, packet: Packet) -> None:
    decoder = codec.Decoder()
    found = [p for byte in b"\x0f\xf0\x81\x00\xf0" + frame for p in decoder.feed(bytes([byte]), 0.0)]
    assert found == [packet]


def test_the_crcs_own_check_value() -> None:
    assert sciencemode2.crc8(b"123456789") == 0xF4  # CRC-8/SMBUS in the catalogue of parametrised CRCs


@CODECS
@given(data=st.data(), cut=st.randoms(use_true_random=False))
@settings(max_examples=100, deadline=None)
def test_any_packets_in_any_pieces(codec: ModuleType, data: st.DataObject, cut) -> None:
    sent = data.draw(st.lists(packet_of(codec), max_size=5))
    line = b"".join(map(codec.encode, sent))
    decoder, found = codec.Decoder(), []
    while line:
        size = cut.randint(1, 40)
        found += decoder.feed(line[:size], 0.0)
        line = line[size:]
    assert found == sent
    assert decoder.corrupt_frames == 0


@CODECS
@given(data=st.data(), place=st.integers(0, 10**6), change=st.integers(1, 255))
@settings(max_examples=300, deadline=None)
def test_a_wrong_byte_is_never_taken_and_the_next_frame_is(
    codec: ModuleType, data: st.DataObject, place: int, change: int
) -> None:
    """Of one bit in ScienceMode 2: its sum has eight."""
    frame = bytearray(codec.encode(data.draw(packet_of(codec))))
    frame[place % len(frame)] ^= 1 << change % 8 if codec is sciencemode2 else change
    decoder = codec.Decoder()
    assert decoder.feed(bytes(frame), 0.0) == []
    assert decoder.feed(codec.encode(NEXT), 1.0) == [NEXT]


def test_a_damaged_frame_is_kept_as_it_reads() -> None:
    decoder, frame = sciencemode2.Decoder(), bytearray(sciencemode2.encode(Packet(4, 32, bytes.fromhex("0000fa14"))))
    frame[-2] ^= 0x02
    assert decoder.feed(bytes(frame), 0.0) == []
    assert decoder.take_damaged() == [Packet(4, 32, bytes.fromhex("0000fa16"))]
    assert decoder.take_damaged() == []


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_stuffing_is_reversible_and_hides_borders(data: bytes) -> None:
    stuffed = stuff(data)
    assert unstuff(stuffed) == data
    assert not {0xF0, 0x0F} & set(stuffed)


@CODECS
@given(data=st.binary(max_size=600))
@settings(max_examples=200, deadline=None)
def test_garbage_raises_nothing(codec: ModuleType, data: bytes) -> None:
    decoder = codec.Decoder()
    decoder.feed(data, 0.0)
    assert decoder.feed(codec.encode(NEXT), 1.0)[-1:] == [NEXT]


@CODECS
def test_half_a_frame_of_a_dead_client_does_not_swallow_the_next(codec: ModuleType) -> None:
    decoder, frame = codec.Decoder(patience_s=0.1), codec.encode(Packet(3, 2, bytes(32)))
    assert decoder.feed(frame[:20], 0.0) == []
    assert decoder.feed(codec.encode(NEXT), 0.5) == [NEXT]
    assert decoder.corrupt_frames == 1
