"""The two stimulators: the pulses that the rig asks for, what the device answers, and cables on the wrong device.

Their frames: test_framing.py.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.rig.devices import p24, rehastim2
from stimrig.rig.devices._line import Packet
from stimrig.rig.errors import DeviceError, WireError
from stimrig.rig.machine import Told
from tests.rig.test_framing import FRAMES_4
from tests.simulator.virtual_time import VirtualClock, VirtualMachine


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
    data = p24.FRAMING.decode(p24.ll_pulse(1, channel, width_us, half_ma / 2)).data
    points = [(p >> 20, (p >> 10 & 0x3FF) - 300) for p in struct.unpack(">3I", data[1:])]
    assert sum(width * half for width, half in points) == 0
    assert points[0] == (width_us, half_ma)
    assert data[0] == 0x82 | channel << 5


def test_status_and_identity():
    assert p24.parse_status(b"\0\1\6") == (0, 1, 6)
    with pytest.raises(WireError):
        p24.parse_status(b"\0")
    assert p24.parse_device_id(b"\0SN12345678") == "SN12345678"
    assert p24.parse_version(bytes([0, 3, 2, 1, 4, 0, 1])) == "3.2.1 (ScienceMode 4.0.1)"
    assert p24.parse_version(b"\0") == ""


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x08", b"\xff"])
def test_every_answer_but_the_good_one_is_an_error(data: bytes, monkeypatch: pytest.MonkeyPatch):
    """Also one without a result: it confirms nothing."""
    machine = VirtualMachine(VirtualClock())
    monkeypatch.setattr(machine, "port", lambda *_, **__: SimpleNamespace())
    device = p24.P24(p24.Settings(device="p24", port="/dev/p24"), machine)

    async def ask(*_: object) -> Packet:
        return Packet(0, 1, data)

    monkeypatch.setattr(device._line, "ask", ask)
    monkeypatch.setattr(device._line, "discard", lambda: None)
    for asked in (device.arm, device.stop):
        with pytest.raises(DeviceError, match="error"):
            machine.run(asked())


def test_results_are_signed():
    assert rehastim2.ERRORS[rehastim2.result_of(b"\xfe")] == "electrode error"
    assert rehastim2.result_text(rehastim2.result_of(b"\xf8")) == "busy"
    assert rehastim2.result_of(b"") == -1
    assert rehastim2.result_text(-77) == "error -77"


def test_a_single_pulse_and_what_cannot_be_one():
    assert rehastim2.single_pulse(9, 0, 300, 24.0) == rehastim2.FRAMING.encode(Packet(9, 36, bytes((0, 1, 44, 24))))
    for wrong in ((0, 19, 20), (0, 501, 20), (0, 300, 25), (0, 300, 128), (0, 300, -2), (8, 300, 20), (-1, 300, 20)):
        with pytest.raises(WireError):
            rehastim2.single_pulse(1, *wrong)
    with pytest.raises(WireError):
        rehastim2.single_pulse(1, 0, 299.5, 20)  # pyright: ignore[reportArgumentType]
    with pytest.raises(WireError):
        rehastim2.single_pulse(1, 0, 300, float("nan"))


REHASTIM_OFFER = bytes.fromhex("f0814781560001010f")
PORT = "/dev/serial/by-id/usb-wrong"


class Other(VirtualMachine):
    """A machine with something else at the end of its line, which keeps what it hears and answers as told."""

    def __init__(self, answer: Callable[[bytes], bytes], greeting: bytes = b"") -> None:
        super().__init__()
        self.heard, self._answer, self._greeting = b"", answer, greeting

    def port(self, path: str, **arguments: Any) -> Other:
        self.asked = path, arguments
        return self

    def open(self, on_bytes: Callable[[bytes, float], None], on_lost: Told) -> None:
        self._on_bytes, self._on_lost = on_bytes, on_lost
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
            self.clock.call_at(now_s + 0.001, lambda: self._on_bytes(data, now_s + 0.001))


ANSWERS: dict[str, tuple[Callable[[bytes], bytes], bytes]] = {
    "silent": (lambda _: b"", b""),
    "a RehaStim 2": (lambda _: REHASTIM_OFFER, REHASTIM_OFFER),
    "a P24": (lambda _: bytes.fromhex("f0815581588125810710 0100 0f".replace(" ", "")), b""),
    "an echo": (lambda data: data, b""),
    "a modem": (lambda _: b"\r\nERROR\r\n", b"RING\r\n"),
}


DRIVERS: dict[str, tuple[Any, set[Any]]] = {
    "a P24": (p24, {p24.Command.DEVICE_ID, p24.Command.EXTENDED_VERSION, p24.Command.STIM_STATUS}),
    "a RehaStim 2": (rehastim2, {rehastim2.Command.GET_MODE}),
}


@pytest.mark.parametrize(("of", "what"), [(of, what) for of in DRIVERS for what in ANSWERS if what != of])
def test_a_stimulator_that_is_another_is_only_asked_who_it_is(of: str, what: str):
    line, (driver, asking) = Other(*ANSWERS[what]), DRIVERS[of]
    device = driver.create(driver.Settings(device=driver.__name__.rpartition(".")[2], port=PORT), line)
    device.listen(lambda _: None, lambda _: None)
    with pytest.raises(DeviceError, match=PORT):
        line.run(device.open())
    commands = {packet.command for packet in driver.FRAMING.reader().feed(line.heard)}
    assert commands
    assert commands <= asking


def test_a_mistake_in_a_driver_is_told_at_once():
    told, line = [], Other(lambda _: bytes.fromhex("f08155815a814381d514030000000f"))
    device = p24.create(p24.Settings(device="p24", port=PORT), line)
    device.listen(lambda _: None, told.append)

    def break_(_packet: object, _time_s: float) -> None:
        raise ZeroDivisionError("a mistake")

    device._line._on_packet = break_
    asked_s = line.clock.now_s()
    with pytest.raises(DeviceError, match="internal: ZeroDivisionError: a mistake"):
        line.run(device.open())
    assert line.clock.now_s() - asked_s < 0.01
    assert "internal: ZeroDivisionError: a mistake" in told[0]
