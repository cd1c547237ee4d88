"""ScienceMode 2 against the vectors of an independent client and of the device (devices.md)."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import WireError
from rig.wire import sciencemode2 as wire
from rig.wire.framing import Packet

VECTORS = {
    "InitAck pn0": ("f0 81 7f 81 56 00 02 00 0f", Packet(0, 2, b"\x00")),
    "Watchdog pn1": ("f0 81 5c 81 57 01 04 0f", Packet(1, 4)),
    "InitList pn3": (
        "f0 81 35 81 5c 03 1e 00 01 00 0d 00 30 00 0f",
        Packet(3, 30, bytes((0, 1, 0, 13, 0, 48, 0))),
    ),
    "Start pn4 250us 20mA": ("f0 81 6f 81 53 04 20 00 00 fa 14 0f", Packet(4, 32, bytes((0, 0, 250, 20)))),
    "Start pn5 271us 20mA": ("f0 81 50 81 52 05 20 00 01 81 5a 14 0f", Packet(5, 32, bytes((0, 1, 15, 20)))),
    "Start pn7 129us 15mA": ("f0 81 0c 81 5d 07 20 00 00 81 d4 81 5a 0f", Packet(7, 32, bytes((0, 0, 129, 15)))),
    "Stop pn8": ("f0 81 13 81 57 08 22 0f", Packet(8, 34)),
    "SinglePulse pn9 300us 25mA": ("f0 81 ae 81 53 09 24 00 01 2c 19 0f", Packet(9, 36, bytes((0, 1, 44, 25)))),
    "Watchdog pn15": ("f0 81 a7 81 56 81 5a 04 0f", Packet(15, 4)),
    "GetMode pn2": ("f0 81 49 81 57 02 0a 0f", Packet(2, 10)),
    "Init pn0 v1": ("f0 81 47 81 56 00 01 01 0f", Packet(0, 1, b"\x01")),
    "StartAck pn4": ("f0 81 45 81 56 04 21 00 0f", Packet(4, 33, b"\x00")),
    "StimError electrode": ("f0 81 1a 81 56 01 26 fe 0f", Packet(1, 38, b"\xfe")),
}


@pytest.mark.parametrize("name", VECTORS)
def test_vectors_both_ways(name: str):
    frame, packet = bytes.fromhex(VECTORS[name][0]), VECTORS[name][1]
    assert wire.FRAMING.encode(packet) == frame
    assert wire.FRAMING.decode(frame) == packet
    assert list(wire.FRAMING.reader().feed(frame)) == [packet]


def test_results_are_signed():
    assert wire.ERRORS[wire.result_of(VECTORS["StimError electrode"][1].data)] == "electrode error"
    assert wire.result_text(wire.result_of(b"\xf8")) == "busy"
    assert wire.result_of(b"") == -1
    assert wire.result_text(-77) == "error -77"


def test_a_single_pulse_and_what_cannot_be_one():
    assert wire.single_pulse(9, 0, 300, 24.0) == wire.FRAMING.encode(Packet(9, 36, bytes((0, 1, 44, 24))))
    for wrong in ((0, 19, 20), (0, 501, 20), (0, 300, 25), (0, 300, 128), (0, 300, -2), (8, 300, 20), (-1, 300, 20)):
        with pytest.raises(WireError):
            wire.single_pulse(1, *wrong)
    with pytest.raises(WireError):
        wire.single_pulse(1, 0, 299.5, 20)  # pyright: ignore[reportArgumentType]
    with pytest.raises(WireError):
        wire.single_pulse(1, 0, 300, float("nan"))


@given(st.binary(max_size=40), st.integers(0, 10), st.integers(1, 255))
def test_after_damage_the_next_frames_are_found(junk: bytes, at: int, change: int):
    good = wire.FRAMING.encode(Packet(9, 37, b"\x00"))
    broken = bytearray(wire.FRAMING.encode(Packet(8, 37, b"\x00\x01\x02")))
    broken[at % len(broken)] ^= change
    reader = wire.FRAMING.reader()
    got = list(reader.feed(junk + bytes(broken) + good * 30))
    assert got.count(Packet(9, 37, b"\x00")) >= 5


def test_a_body_longer_than_its_length_field_is_refused():
    longest = Packet(1, 36, bytes(253))
    assert list(wire.FRAMING.reader().feed(wire.FRAMING.encode(longest))) == [longest]
    with pytest.raises(WireError):
        wire.FRAMING.encode(Packet(1, 36, bytes(254)))


@pytest.mark.parametrize(
    "text", ["", "f0", "f0 81 5c 81 57 01 04 0e", "f0 81 5d 81 57 01 04 0f", "f0 00 5c 81 57 01 04 0f"]
)
def test_what_is_no_frame_is_told(text: str):
    with pytest.raises(WireError):
        wire.FRAMING.decode(bytes.fromhex(text))
