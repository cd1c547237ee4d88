"""Cables on the wrong device: a driver that hears nothing of its own kind says so and sends nothing that stimulates."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from rig.clock import MonotonicClock
from rig.devices import p24, rehastim2
from rig.errors import DeviceError
from rig.wire import sciencemode2, sciencemode4

REHASTIM_OFFER = bytes.fromhex("f0814781560001010f")


class Other:
    """Something else at the end of the line: keeps what it hears, answers as told."""

    def __init__(self, answer: Callable[[bytes], bytes], greeting: bytes = b"") -> None:
        self.heard = b""
        self._answer = answer
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        os.write(self._master, greeting)
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        try:
            while data := os.read(self._master, 4096):
                self.heard += data
                if answer := self._answer(data):
                    os.write(self._master, answer)
        except OSError:
            return

    def close(self) -> None:
        os.close(self._slave)
        os.close(self._master)


@contextmanager
def other(answer: Callable[[bytes], bytes], greeting: bytes = b"") -> Iterator[Other]:
    made = Other(answer, greeting)
    try:
        yield made
    finally:
        made.close()


ANSWERS: dict[str, tuple[Callable[[bytes], bytes], bytes]] = {
    "silent": (lambda _: b"", b""),
    "a RehaStim 2": (lambda _: REHASTIM_OFFER, REHASTIM_OFFER),
    "a P24": (lambda _: bytes.fromhex("f0815581588125810710 0100 0f".replace(" ", "")), b""),
    "an echo": (lambda data: data, b""),
    "a modem": (lambda _: b"\r\nERROR\r\n", b"RING\r\n"),
}


@pytest.mark.parametrize("what", [name for name in ANSWERS if name != "a P24"])
def test_a_p24_that_is_none(what: str):
    with other(*ANSWERS[what]) as line:
        device = p24.create(p24.Settings(device="p24", port=line.port, reply_timeout_s=0.1), MonotonicClock())
        device.listen(lambda _: None, lambda _: None)
        with pytest.raises(DeviceError, match=line.port):
            device.open()
        commands = {packet.command for packet in sciencemode4.FRAMING.reader().feed(line.heard)}
    asking = {
        sciencemode4.Command.DEVICE_ID, sciencemode4.Command.EXTENDED_VERSION, sciencemode4.Command.STIM_STATUS,
    }  # fmt: skip
    assert commands
    assert commands <= asking


@pytest.mark.parametrize("what", [name for name in ANSWERS if name != "a RehaStim 2"])
def test_a_rehastim2_that_is_none(what: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rehastim2, "OFFER_S", 0.1)
    with other(*ANSWERS[what]) as line:
        settings = rehastim2.Settings(device="rehastim2", port=line.port, reply_timeout_s=0.1)
        device = rehastim2.create(settings, MonotonicClock())
        device.listen(lambda _: None, lambda _: None)
        with pytest.raises(DeviceError, match=line.port):
            device.open()
        commands = {packet.command for packet in sciencemode2.FRAMING.reader().feed(line.heard)}
    assert commands == {sciencemode2.Command.GET_MODE}


def test_a_mistake_in_a_driver_is_told_at_once(monkeypatch: pytest.MonkeyPatch):
    told, lost = [], threading.Event()
    with other(lambda _: b"") as line:
        device = p24.create(p24.Settings(device="p24", port=line.port, reply_timeout_s=0.2), MonotonicClock())
        device.listen(lambda _: None, lambda reason: (told.append(reason), lost.set()))

        def break_(_packet: object, _time_s: float) -> None:
            raise ZeroDivisionError("a mistake")

        device._line._on_packet = break_
        with pytest.raises(DeviceError):
            device.open()
        device._line.open()
        os.write(line._master, bytes.fromhex("f08155815a814381d514030000000f"))
        assert lost.wait(2)
        device.close()
    assert "internal: ZeroDivisionError: a mistake" in told[0]
