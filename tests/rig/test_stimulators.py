"""The two stimulators: their frames against vectors of published clients, their pulses and answers, swapped cables."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2, ScienceMode4
from stimrig.rig.devices import library, p24, rehastim2
from stimrig.rig.devices._line import SCIENCEMODE_2, SCIENCEMODE_4, FrameReader, Framing
from stimrig.rig.devices._line import Packet as RigsPacket
from stimrig.rig.errors import DeviceError, WireError
from stimrig.rig.limits import Admitted
from stimrig.rig.machine import OnMessage
from stimrig.rig.signals import Ack
from tests.simulator.virtual_time import VirtualMachine


@pytest.mark.parametrize(("number", "width_us", "current_ma"), [(5, 250, 20.0), (6, 300, 20.5), (15, 240, 20.0)])
def test_client_frames_are_those_of_the_published_client(number: int, width_us: int, current_ma: float):
    frame, _ = FRAMES_4[f"LLConfig {width_us} us {current_ma:g} mA"]
    assert p24.ll_pulse(number, 0, width_us, current_ma).hex(" ") == frame


@pytest.mark.parametrize(
    ("width_us", "current_ma"), [(0, 20.0), (4096, 20.0), (250.5, 20.0), (250, 20.25), (250, -1.0), (250, 130.5)]
)
def test_a_pulse_that_the_frame_cannot_carry_is_refused(width_us: int, current_ma: float):
    with pytest.raises(WireError):
        p24.ll_pulse(1, 0, width_us, current_ma)


@given(st.integers(1, 4095), st.integers(0, 260), st.integers(0, 3))
def test_every_pulse_is_balanced(width_us: int, half_ma: int, channel: int):
    data = SCIENCEMODE_4.decode(p24.ll_pulse(1, channel, width_us, half_ma / 2)).data
    points = [(p >> 20, (p >> 10 & 0x3FF) - 300) for p in struct.unpack(">3I", data[1:])]
    assert sum(width * half for width, half in points) == 0
    assert points[0] == (width_us, half_ma)
    assert data[0] == 0x82 | channel << 5


PORT = "/dev/serial/by-id/usb-wrong"
DRIVERS = library("stimulator")


class Wire(VirtualMachine):
    """A machine with something at the end of its line, which keeps what it hears and answers as told."""

    def __init__(self, answer: Callable[[bytes], bytes], greeting: bytes) -> None:
        super().__init__()
        self.heard, self._answer, self._greeting = b"", answer, greeting
        self.acks, self.lost = list[Ack](), list[str]()

    def port(self, *_: Any, **__: Any) -> Wire:
        return self

    def open(self, on_bytes: Callable[[bytes, float], None], _on_lost: OnMessage) -> None:
        self.take = on_bytes
        self._say(self._greeting)

    def write(self, data: bytes) -> int:
        self.heard += data
        self._say(self._answer(data))
        return len(data)

    def discard(self) -> None: ...

    def close(self) -> None: ...

    def _say(self, data: bytes) -> None:
        now_s = self.clock.now_s()
        if data:
            self.clock.call_at(now_s + 0.001, lambda: self.take(data, now_s + 0.001))


def on_wire(
    of: str, answer: Callable[[bytes], bytes] = lambda _: b"", greeting: bytes = b"", **settings: int
) -> tuple[Any, Wire]:
    """A driver that is not opened."""
    wire, module = Wire(answer, greeting), DRIVERS[of]
    made = module.create(module.Settings(device=of, port=PORT, **settings), wire)
    made.listen(wire.acks.append, wire.lost.append)
    return made, wire


def opened(of: str, **settings: int) -> tuple[Any, Wire]:
    """A driver whose port is open, on a line that says nothing by itself."""
    made, wire = on_wire(of, **settings)
    wire.open(made._read, made._lose)
    made._lost = ""
    return made, wire


def answers_with(data: dict[int, bytes]) -> Callable[[bytes], bytes]:
    """A P24 that acknowledges each command with these bytes, else with its result alone: fine."""

    def answer(frame: bytes) -> bytes:
        asked = SCIENCEMODE_4.decode(frame)
        return SCIENCEMODE_4.encode(RigsPacket(asked.number, asked.command + 1, data.get(asked.command, b"\0")))

    return answer


IDENTITY = {52: b"\0SN12345678", 68: bytes([0, 3, 2, 1, 4, 0, 1]), 62: b"\0\1\6"}


def test_status_and_identity_of_a_p24():
    made, wire = on_wire("p24", answers_with(IDENTITY))
    told = wire.run(made.open())
    assert (told["id"], told["firmware"]) == ("SN12345678", "3.2.1 (ScienceMode 4.0.1)")
    assert (told["state"], wire.run(made.state())[0]) == ("low level initialised", False)
    made, wire = on_wire("p24", answers_with(IDENTITY | {68: b"\0"}))
    assert wire.run(made.open())["firmware"] == ""
    made, wire = on_wire("p24", answers_with(IDENTITY | {62: b"\0"}))
    with pytest.raises(WireError, match="status ack of 1 bytes"):
        wire.run(made.open())


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x08", b"\xff"])
def test_every_answer_but_the_good_one_is_an_error(data: bytes):
    """Also one without a result: it confirms nothing."""
    made, wire = on_wire("p24", answers_with(IDENTITY | {0: data, 4: data}))
    wire.run(made.open())
    for asked in (made.arm, made.stop):
        with pytest.raises(DeviceError, match="error"):
            wire.run(asked())


def test_results_are_signed():
    assert rehastim2.ERRORS[rehastim2.result_of(b"\xfe")] == "electrode error"
    assert rehastim2.result_text(rehastim2.result_of(b"\xf8")) == "busy"
    assert rehastim2.result_of(b"") == -1
    assert rehastim2.result_text(-77) == "error -77"


def test_a_single_pulse_and_what_cannot_be_one():
    assert rehastim2.single_pulse(9, 0, 300, 24.0) == SCIENCEMODE_2.encode(RigsPacket(9, 36, bytes((0, 1, 44, 24))))
    for wrong in ((0, 19, 20), (0, 501, 20), (0, 300, 25), (0, 300, 128), (0, 300, -2), (8, 300, 20), (-1, 300, 20)):
        with pytest.raises(WireError):
            rehastim2.single_pulse(1, *wrong)
    with pytest.raises(WireError):
        rehastim2.single_pulse(1, 0, 299.5, 20)
    with pytest.raises(WireError):
        rehastim2.single_pulse(1, 0, 300, float("nan"))


REHASTIM_OFFER = bytes.fromhex("f0814781560001010f")
ANSWERS: dict[str, tuple[Callable[[bytes], bytes], bytes]] = {
    "silent": (lambda _: b"", b""),
    "rehastim2": (lambda _: REHASTIM_OFFER, REHASTIM_OFFER),
    "p24": (lambda _: bytes.fromhex("f0815581588125810710 0100 0f".replace(" ", "")), b""),
    "an echo": (lambda data: data, b""),
    "a modem": (lambda _: b"\r\nERROR\r\n", b"RING\r\n"),
}
ASKING: dict[str, set[Any]] = {
    "p24": {p24.Command.DEVICE_ID, p24.Command.EXTENDED_VERSION, p24.Command.STIM_STATUS},
    "rehastim2": {rehastim2.Command.GET_MODE},
}
"""Each driver's commands that change nothing at the device."""


@pytest.mark.parametrize(("of", "what"), [(of, what) for of in DRIVERS for what in ANSWERS if what != of])
def test_a_stimulator_that_is_another_is_only_asked_who_it_is(of: str, what: str):
    made, wire = on_wire(of, *ANSWERS[what])
    with pytest.raises(DeviceError, match=PORT):
        wire.run(made.open())
    commands = {packet.command for packet in FrameReader(made.framing).feed(wire.heard)}
    assert commands
    assert commands <= ASKING[of]


def test_a_mistake_in_a_driver_is_told_at_once():
    made, wire = on_wire("p24", answers_with(IDENTITY))
    made._handle = Mock(side_effect=ZeroDivisionError("a mistake"))
    asked_s = wire.clock.now_s()
    with pytest.raises(DeviceError, match="internal: ZeroDivisionError: a mistake"):
        wire.run(made.open())
    assert wire.clock.now_s() - asked_s < 0.01
    assert "internal: ZeroDivisionError: a mistake" in wire.lost[0]


FRAMES_2 = {
    "InitAck": ("f0 81 7f 81 56 00 02 00 0f", Packet(0, 2, b"\x00")),
    "Watchdog": ("f0 81 5c 81 57 01 04 0f", Packet(1, 4, b"")),
    "Start 129 us 15 mA": ("f0 81 0c 81 5d 07 20 00 00 81 d4 81 5a 0f", Packet(7, 32, bytes.fromhex("00 0081 0f"))),
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
    "LLInitAck": ("f0 81 55 81 58 81 25 81 07 10 01 00 0f", Packet(4, 1, b"\x00")),
    "LLConfigAck": ("f0 81 55 81 5a 81 43 81 d5 14 03 00 00 00 0f", Packet(5, 3, bytes(3))),
    "LLConfigAck electrode": ("f0 81 55 81 5a 81 84 81 14 14 03 0a 00 00 0f", Packet(5, 3, b"\x0a\x00\x00")),
}


class Codec(NamedTuple):
    """Of the rig or of the emulator."""

    version: int
    encode: Callable[[Packet], bytes]
    decoder: Callable[[], Any]
    lost: int
    """Most frames behind a damaged one that are lost with it."""
    damaged: str
    """Name of the decoder's count."""


def of_rig(version: int, framing: Framing) -> Codec:
    return Codec(
        version, lambda packet: framing.encode(RigsPacket(*packet)), lambda: FrameReader(framing), 1, "damaged"
    )


CODECS = {
    "rig 2": of_rig(2, SCIENCEMODE_2),
    "rig 4": of_rig(4, SCIENCEMODE_4),
    "emulator 2": Codec(2, ScienceMode2.encode, ScienceMode2, 0, "corrupt_frames"),
    "emulator 4": Codec(4, ScienceMode4.encode, ScienceMode4, 0, "corrupt_frames"),
}
EACH = pytest.mark.parametrize("codec", CODECS.values(), ids=CODECS)
VECTORS = [
    pytest.param(codec, bytes.fromhex(text), packet, id=f"{of} {name}")
    for of, codec in CODECS.items()
    for name, (text, packet) in {2: FRAMES_2, 4: FRAMES_4}[codec.version].items()
]
NEXT = Packet(1, 4, b"")


def read(decoder: Any, data: bytes, time_s: float = 0.0) -> list[Packet]:
    """The rig's knows no time."""
    found = decoder.feed(data, time_s) if hasattr(decoder, "corrupt_frames") else decoder.feed(data)
    return [Packet(packet.number, packet.command, packet.data) for packet in found]


def packet_of(codec: Codec) -> st.SearchStrategy[Packet]:
    number, command, size = {2: (255, 255, 32), 4: (63, 1023, 80)}[codec.version]
    return st.builds(Packet, st.integers(0, number), st.integers(0, command), st.binary(max_size=size))


@pytest.mark.parametrize(("codec", "frame", "packet"), VECTORS)
def test_vectors_both_ways_also_byte_by_byte_and_after_noise(codec: Codec, frame: bytes, packet: Packet):
    assert codec.encode(packet) == frame
    assert read(codec.decoder(), frame) == [packet]
    decoder = codec.decoder()
    assert [p for byte in b"\x0f\xf0\x81\x00\xf0" + frame for p in read(decoder, bytes([byte]))] == [packet]


@EACH
@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_any_packets_in_any_pieces(codec: Codec, data: st.DataObject):
    sent = data.draw(st.lists(packet_of(codec), max_size=5))
    line, decoder, found = b"".join(map(codec.encode, sent)), codec.decoder(), list[Packet]()
    assert line == b"".join(map(CODECS[f"emulator {codec.version}"].encode, sent)), "the two agree"
    while line:
        size = data.draw(st.integers(1, 40))
        found += read(decoder, line[:size])
        line = line[size:]
    assert found == sent
    assert getattr(decoder, codec.damaged) == 0


@EACH
@given(stray=st.binary(max_size=30).filter(lambda b: b"\xf0" not in b))
def test_stray_bytes_before_a_frame_cost_nothing(codec: Codec, stray: bytes):
    assert read(codec.decoder(), stray + codec.encode(NEXT)) == [NEXT]


@EACH
@given(data=st.data(), place=st.integers(0, 10**6), change=st.integers(1, 255))
@settings(max_examples=150, deadline=None)
def test_a_wrong_byte_is_never_taken_and_costs_its_frame_only(
    codec: Codec, data: st.DataObject, place: int, change: int
):
    """Of one bit in ScienceMode 2: its sum has eight."""
    frame = bytearray(codec.encode(data.draw(packet_of(codec))))
    frame[place % len(frame)] ^= 1 << change % 8 if codec.version == 2 else change
    decoder = codec.decoder()
    assert read(decoder, bytes(frame)) == []
    found = read(decoder, 2 * codec.encode(NEXT), 1.0) + read(decoder, bytes(4100), 1.0)  # of a length that is wrong
    assert found in ([NEXT] * (2 - lost) for lost in range(codec.lost + 1))


def test_a_wrong_length_never_makes_one_packet_of_three_frames():
    """The length is in no sum, and with what lies in between one of eight bits may happen to fit."""
    rig = CODECS["rig 2"]
    frame = bytearray(rig.encode(Packet(42, 42, bytes.fromhex("2a84626e819dd1"))))
    frame[4] ^= 1 << 4
    assert read(rig.decoder(), bytes(frame) + 2 * rig.encode(NEXT)) == [NEXT, NEXT]


@EACH
@given(garbage=st.binary(max_size=600))
@settings(max_examples=60, deadline=None)
def test_after_garbage_frames_are_found_again(codec: Codec, garbage: bytes):
    """The rig's waits for as many bytes as a length in it says, the emulator's for a moment."""
    decoder = codec.decoder()
    read(decoder, garbage)
    assert read(decoder, (400 if codec.lost else 1) * codec.encode(NEXT), 1.0)[-1:] == [NEXT]


@pytest.mark.parametrize("wire", [ScienceMode2, ScienceMode4])
def test_half_a_frame_of_a_dead_client_does_not_swallow_the_next(wire: Any):
    decoder, frame = wire(), wire.encode(Packet(3, 2, bytes(32)))
    assert decoder.feed(frame[:20], 0.0) == []
    assert decoder.feed(wire.encode(NEXT), 0.5) == [NEXT]
    assert decoder.corrupt_frames == 1


def test_a_damaged_frame_is_kept_as_it_reads():
    decoder, frame = ScienceMode2(), bytearray(ScienceMode2.encode(Packet(4, 32, bytes.fromhex("0000fa14"))))
    frame[-2] ^= 0x02
    assert decoder.feed(bytes(frame), 0.0) == []
    assert decoder.take_damaged() == [Packet(4, 32, bytes.fromhex("0000fa16"))]
    assert decoder.take_damaged() == []


@pytest.mark.parametrize(
    "text", ["", "f0", "f0 81 5c 81 57 01 04 0e", "f0 81 5d 81 57 01 04 0f", "f0 00 5c 81 57 01 04 0f"]
)
def test_what_is_no_frame_is_told(text: str):
    with pytest.raises(WireError):
        SCIENCEMODE_2.decode(bytes.fromhex(text))


def test_a_body_longer_than_its_length_field_is_refused():
    longest = Packet(1, 36, bytes(253))
    rigs = CODECS["rig 2"]
    assert read(rigs.decoder(), rigs.encode(longest)) == [longest]
    with pytest.raises(WireError):
        rigs.encode(Packet(1, 36, bytes(254)))


def test_each_driver_sends_to_the_output_of_the_rig_file():
    made, wire = opened("p24", channel=4, connector=2)
    made.send(Admitted(250, 20.0), 1e9)
    head = SCIENCEMODE_4.decode(wire.heard).data[0]
    assert (head >> 7, head >> 5 & 3, head >> 4 & 1) == (1, 3, 1)
    made, wire = opened("rehastim2", channel=8)
    made.send(Admitted(250, 20.0), 1e9)
    assert SCIENCEMODE_2.decode(wire.heard).data[0] == 7


@pytest.mark.parametrize(("place", "ours"), [(0x00, False), (0x13, True), (0x10, False), (0x03, False)])
def test_a_p24s_ack_of_another_output_is_an_error(place: int, ours: bool):
    made, wire = opened("p24", channel=4, connector=2)
    number = made.send(Admitted(250, 20.0), 1e9)
    wire.take(SCIENCEMODE_4.encode(RigsPacket(number, 3, bytes((0, place, 0)))), 0.0)
    (ack,) = wire.acks
    assert ack.number == number
    assert ack.error == (None if ours else "it acknowledged a pulse of an output that is not in use instead")


def test_the_vendors_acks_are_of_the_first_output():
    made, wire = opened("p24")
    for number in range(1, 6):
        assert made.send(Admitted(250, 20.0), 1e9) == number
    wire.take(bytes.fromhex(FRAMES_4["LLConfigAck"][0]), 0.0)
    assert [(ack.number, ack.error) for ack in wire.acks] == [(5, None)]
