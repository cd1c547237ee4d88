"""examples/lsl_bridge.py: what the live channel shows goes to Lab Streaming Layer, here a stand-in for pylsl."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from stimrig.api.sessions.live import LiveOut

SCRIPT = Path(__file__).parents[2] / "examples" / "lsl_bridge.py"
NOW_S = 1000.0


class Outlet:
    def __init__(self) -> None:
        self.sent: list[tuple[list[Any], float]] = []

    def push_sample(self, values: list[Any], at_s: float) -> None:
        self.sent.append((list(values), round(at_s, 6)))


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("lsl_bridge", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def live(elapsed_s: float, segment: str, time_s: list[float], pulses: list[tuple[float, float]]) -> dict[str, Any]:
    """A message as the service sends it (`stimrig.api.sessions.live.Hub.live`)."""
    event = LiveOut(
        test_id="T1", segment=segment, elapsed_s=elapsed_s, duration_s=9, time_s=time_s,
        torque_min_nm=[-1.0] * len(time_s), torque_max_nm=[1.0] * len(time_s),
        pulse_time_s=[at_s for at_s, _ in pulses], pulse_width_us=[width_us for _, width_us in pulses],
        torque_age_s=0.0, lost_samples=0, dropped_pulses=0,
    )  # fmt: skip
    return {"type": "live", **event.model_dump(exclude={"event"})}


def test_each_bin_pulse_and_mark_is_sent_at_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(cf_double64=1, cf_string=3, local_clock=lambda: NOW_S)
    monkeypatch.setitem(sys.modules, "pylsl", fake)
    bridge = load()

    def messages(test_id: str) -> Iterator[dict[str, Any]]:
        assert test_id == "T1"
        first = live(0.5, "rest", [0.45], [])
        history = {"type": "history", **{key: first[key] for key in ("pulse_time_s", "pulse_width_us")},
                   "time_s": [0.4], "torque_min_nm": [-2.0], "torque_max_nm": [2.0]}  # fmt: skip
        yield from (history, {"type": "state"}, first, live(1.0, "prbs", [0.95], [(0.9, 200.0), (0.925, 0.0)]))
        yield {"type": "test", "test": {"done": True}}

    outlets = {part: Outlet() for part in bridge.STREAMS}
    bridge.follow(SimpleNamespace(live=messages), "T1", outlets)
    zero_s = NOW_S - 1.0  # of the message with the least delay
    assert outlets["torque"].sent == [
        ([-2.0, 2.0], NOW_S - 0.1), ([-1.0, 1.0], NOW_S - 0.05), ([-1.0, 1.0], zero_s + 0.95),
    ]  # fmt: skip
    assert outlets["pulses"].sent == [([200.0], zero_s + 0.9)]
    marks = [(values[0], at_s) for values, at_s in outlets["marks"].sent]
    assert marks == [("start T1", NOW_S - 0.5), ("rest", NOW_S), ("prbs", NOW_S), ("end T1", NOW_S)]
