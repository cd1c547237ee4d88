"""The serial line: what it refuses to drive."""

from __future__ import annotations

import os

import pytest

from rig.clock import MonotonicClock
from rig.devices import _line, p24
from rig.errors import DeviceError


def test_a_clock_that_runs_fast_drives_an_emulator_only(monkeypatch: pytest.MonkeyPatch):
    """Whatever the rig was told of its port: the port itself is looked at, at each opening."""
    master, slave = os.openpty()
    port = os.ttyname(slave)
    try:
        for speed, elsewhere, words in (
            (50.0, True, "real device"),
            (1.0, True, "no answer"),
            (50.0, False, "no answer"),
        ):
            monkeypatch.setattr(_line, "PSEUDO_TERMINALS", "/nowhere/" if elsewhere else "/dev/pts/")
            settings = p24.Settings(device="p24", port=port, reply_timeout_s=0.05)
            device = p24.create(settings, MonotonicClock(speed))
            with pytest.raises(DeviceError, match=words):
                device.open()
    finally:
        os.close(master)
        os.close(slave)
