"""The outlets: three streams of LSL that exist for as long as the process, whether a test plays or not.

So a LabRecorder that was started before the first test records them all. What differs from test to test (its ids, the
participant's code, begin and end) goes out as marks.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from stimrig.rig.clock import MonotonicClock
from stimrig.rig.errors import RigError
from stimrig.rig.lsl_outlets.live_test import Batch

PULSE_CHANNELS = (("pulse_width", "µs"), ("current", "mA"), ("index", "1"))


class NoLibraryError(RigError):
    """LSL is not installed."""

    code = "no-library"
    title = "LSL is not installed"


def library() -> Any:
    """pylsl with its library. Raises NoLibraryError."""
    try:
        import pylsl
    except (ImportError, RuntimeError, OSError) as error:
        said = " ".join(str(error).split())[:200]
        raise NoLibraryError(f"lsl: pylsl is not there ({said}); pip install 'stimrig[lsl]'") from None
    return pylsl


def clock_offset_s(lsl: Any) -> float:
    """LSL's clock minus the rig's at speed 1, s: on Linux what the machine was suspended, and the readings' delay."""
    clock, shortest_s, offset_s = MonotonicClock(), np.inf, 0.0
    for _ in range(20):
        before_s, lsl_s, after_s = clock.now_s(), lsl.local_clock(), clock.now_s()
        if after_s - before_s < shortest_s:
            shortest_s, offset_s = after_s - before_s, lsl_s - (before_s + after_s) / 2
    return offset_s


class Outlets:
    """Torque, pulses and marks.

    Parameters
    ----------
    lsl
        What `library` gave.
    sample_rate_hz
        Nominal rate of the cell in samples per real second; 0: not known.
    devices
        Load cell and stimulator, as the rig file names them.
    name
        The streams' names begin so.
    """

    def __init__(self, lsl: Any, sample_rate_hz: float, devices: dict[str, str], name: str = "stimrig") -> None:
        self._lsl, self._name, self._devices = lsl, name, devices
        self._torque = self._open("torque", "Torque", sample_rate_hz, lsl.cf_double64, (("torque", "N·m"),))
        self._pulses = self._open("pulses", "Stimulation", 0.0, lsl.cf_double64, PULSE_CHANNELS)
        self._marks = self._open("tests", "Markers", 0.0, lsl.cf_string, (("mark", "JSON"),))

    @property
    def names(self) -> list[str]:
        """The streams' names."""
        return [f"{self._name}-{part}" for part in ("torque", "pulses", "tests")]

    def push(self, batch: Batch) -> None:
        """Send a batch; it does not wait for those who receive."""
        for time_s, mark in batch.marks:
            if mark["event"] == "start":
                self._mark(time_s, mark)
        if len(batch.torque_s):
            self._torque.push_chunk(batch.torque_nm.reshape(-1, 1), batch.torque_s.tolist())
        if batch.pulses:
            self._pulses.push_chunk(np.array(batch.pulses, np.float64), batch.pulse_s)
        for time_s, mark in batch.marks:
            if mark["event"] != "start":
                self._mark(time_s, mark)

    def wanted(self, which: Callable[[Iterable[bool]], bool] = any) -> bool:
        """Whether somebody receives any, or all, of them."""
        return which(outlet.have_consumers() for outlet in (self._torque, self._pulses, self._marks))

    def _mark(self, time_s: float, mark: dict[str, Any]) -> None:
        self._marks.push_sample([json.dumps(mark, ensure_ascii=False)], time_s)

    def _open(self, part: str, kind: str, rate_hz: float, form: int, channels: tuple[tuple[str, str], ...]) -> Any:
        lsl = self._lsl
        source = f"{self._name}-{part}-{socket.gethostname()}"
        info = lsl.StreamInfo(f"{self._name}-{part}", kind, len(channels), rate_hz, form, source)
        description = info.desc()
        description.append_child_value("manufacturer", "stimrig")
        for device, model in self._devices.items():
            description.append_child_value(device, model)
        listed = description.append_child("channels")
        for label, unit in channels:
            channel = listed.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
            channel.append_child_value("type", kind)
        return lsl.StreamOutlet(info)
