"""ScienceMode 2: the pulses that the rig asks for, and what the device answers; its frames: test_framing.py."""

from __future__ import annotations

import pytest

from stimrig.rig.devices import rehastim2 as wire
from stimrig.rig.errors import WireError
from stimrig.rig.wire.framing import Packet


def test_results_are_signed():
    assert wire.ERRORS[wire.result_of(b"\xfe")] == "electrode error"
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
