"""ScienceMode 4: the vectors of published clients, and streams that are cut and damaged."""

from __future__ import annotations

import binascii
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import WireError
from rig.wire import sciencemode4 as wire
from rig.wire.framing import START, STOP, Packet
from rig.wire.sciencemode4 import Command

CLIENT_FRAMES = {
    "status": (wire.FRAMING.encode(Packet(1, Command.STIM_STATUS)), "f0 81 55 81 59 81 4e 81 0c 04 3e 0f"),
    "init": (wire.FRAMING.encode(Packet(4, Command.LL_INIT, b"\0")), "f0 81 55 81 58 81 16 81 36 10 00 00 0f"),
    "250 us 20 mA": (
        wire.ll_pulse(5, 0, 250, 20.0),
        "f0 81 55 81 4e 81 cd 81 ae 14 02 82 81 5a a5 50 00 06 44 b0 00 81 5a a4 10 00 0f",
    ),
    "300 us 20.5 mA": (
        wire.ll_pulse(6, 0, 300, 20.5),
        "f0 81 55 81 4c 81 e5 81 94 18 02 82 12 c5 54 00 06 44 b0 00 12 c4 0c 00 0f",
    ),
    "stop byte in header": (
        wire.ll_pulse(15, 0, 240, 20.0),
        "f0 81 55 81 4e 81 0f 81 21 3c 02 82 81 5a 05 50 00 06 44 b0 00 81 5a 04 10 00 0f",
    ),
    "stop": (wire.FRAMING.encode(Packet(8, Command.LL_STOP)), "f0 81 55 81 59 81 13 81 37 20 04 0f"),
    "mid level update": (
        wire.FRAMING.encode(
            Packet(
                10, 32, bytes.fromhex("01200064") + struct.pack(">3I", 0x0FA55000, 0x064 << 20 | 0x4B000, 0x0FA41000)
            )
        ),
        "f0 81 55 81 4b 81 22 81 bc 28 20 01 20 00 64 81 5a a5 50 00 06 44 b0 00 81 5a a4 10 00 0f",
    ),
    "mid level stop": (wire.FRAMING.encode(Packet(12, 34)), "f0 81 55 81 59 81 54 81 e0 30 22 0f"),
}

DEVICE_FRAMES = {
    "init ack": ("f0 81 55 81 58 81 25 81 07 10 01 00 0f", Packet(4, 1, b"\0")),
    "pulse ack": ("f0 81 55 81 5a 81 43 81 d5 14 03 00 00 00 0f", Packet(5, 3, b"\0\0\0")),
    "electrode": ("f0 81 55 81 5a 81 84 81 14 14 03 0a 00 00 0f", Packet(5, 3, b"\x0a\0\0")),
}


@pytest.mark.parametrize("name", CLIENT_FRAMES)
def test_client_frames_are_those_of_the_published_client(name: str):
    frame, expected = CLIENT_FRAMES[name]
    assert frame.hex(" ") == expected


@pytest.mark.parametrize("name", DEVICE_FRAMES)
def test_device_frames_are_read(name: str):
    text, packet = DEVICE_FRAMES[name]
    assert wire.FRAMING.decode(bytes.fromhex(text)) == packet
    assert list(wire.FRAMING.reader().feed(bytes.fromhex(text))) == [packet]


packets = st.builds(Packet, st.integers(0, 63), st.integers(0, 1023), st.binary(max_size=60))


@given(packets)
def test_frames_come_back(packet: Packet):
    frame = wire.FRAMING.encode(packet)
    assert wire.FRAMING.decode(frame) == packet
    assert frame[0] == START
    assert frame[-1] == STOP
    assert binascii.crc_hqx(frame[9:-1], 0) == int.from_bytes(bytes(b ^ 0x55 for b in (frame[6], frame[8])), "big")


@given(st.lists(packets, min_size=1, max_size=5), st.data())
def test_a_stream_cut_anywhere_loses_nothing(sent: list[Packet], data: st.DataObject):
    stream = b"".join(wire.FRAMING.encode(p) for p in sent)
    reader, got, at = wire.FRAMING.reader(), [], 0
    while at < len(stream):
        n = data.draw(st.integers(1, len(stream)))
        got += list(reader.feed(stream[at : at + n]))
        at += n
    assert got == sent
    assert reader.damaged == 0


@given(st.binary(max_size=30).filter(lambda b: b"\xf0" not in b), packets)
def test_stray_bytes_before_a_frame_cost_nothing(stray: bytes, packet: Packet):
    assert list(wire.FRAMING.reader().feed(stray + wire.FRAMING.encode(packet))) == [packet]


@given(packets, packets, st.data())
def test_a_flipped_bit_costs_its_frame_only(first: Packet, second: Packet, data: st.DataObject):
    frame = bytearray(wire.FRAMING.encode(first))
    at = data.draw(st.integers(0, len(frame) - 1))
    frame[at] ^= 1 << data.draw(st.integers(0, 7))
    reader = wire.FRAMING.reader()
    got = list(reader.feed(bytes(frame) + wire.FRAMING.encode(second) + wire.FRAMING.encode(second)))
    got += list(reader.feed(bytes(4100)))  # whatever a broken length still waited for
    assert first not in got or first == second
    assert second in got


@pytest.mark.parametrize(
    ("width_us", "current_ma"), [(0, 20.0), (4096, 20.0), (250.5, 20.0), (250, 20.25), (250, -1.0), (250, 130.5)]
)
def test_a_pulse_that_the_frame_cannot_carry_is_refused(width_us: int, current_ma: float):
    with pytest.raises(WireError):
        wire.ll_pulse(1, 0, width_us, current_ma)


@given(st.integers(1, 4095), st.integers(0, 260), st.integers(0, 3))
def test_every_pulse_is_balanced(width_us: int, half_ma: int, channel: int):
    data = wire.FRAMING.decode(wire.ll_pulse(1, channel, width_us, half_ma / 2)).data
    points = [(p >> 20, (p >> 10 & 0x3FF) - 300) for p in struct.unpack(">3I", data[1:])]
    assert sum(width * half for width, half in points) == 0
    assert points[0] == (width_us, half_ma)
    assert data[0] == 0x82 | channel << 5


def test_status_and_identity():
    assert wire.parse_status(b"\0\1\6") == (0, 1, 6)
    with pytest.raises(WireError):
        wire.parse_status(b"\0")
    assert wire.parse_device_id(b"\0SN12345678") == "SN12345678"
    assert wire.parse_version(bytes([0, 3, 2, 1, 4, 0, 1])) == "3.2.1 (ScienceMode 4.0.1)"
    assert wire.parse_version(b"\0") == ""
