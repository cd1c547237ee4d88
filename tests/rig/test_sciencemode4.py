"""ScienceMode 4: the pulses that the rig asks for, and what the device answers; its frames: test_framing.py."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.rig.devices import p24
from stimrig.rig.devices import p24 as wire
from stimrig.rig.errors import DeviceError, WireError
from stimrig.rig.wire.framing import Packet
from tests.rig.test_framing import FRAMES_4
from tests.simulator.virtual_time import VirtualClock, VirtualMachine


@pytest.mark.parametrize(("number", "width_us", "current_ma"), [(5, 250, 20.0), (6, 300, 20.5), (15, 240, 20.0)])
def test_client_frames_are_those_of_the_published_client(number: int, width_us: int, current_ma: float):
    frame, _ = FRAMES_4[f"LLConfig {width_us} us {current_ma:g} mA"]
    assert wire.ll_pulse(number, 0, width_us, current_ma).hex(" ") == frame


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
