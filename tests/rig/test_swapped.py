"""Cables on the wrong device: a driver that hears nothing of its own kind says so and sends nothing that stimulates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from stimrig.rig.devices import p24, rehastim2
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Told
from tests.simulator.virtual_time import VirtualMachine

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
