"""A whole rig with a switch: its relays are open whenever no test plays, whatever was left, and it must be there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig.devices import find
from stimrig.rig.errors import BusyError, DeviceError, RigError
from stimrig.rig.messages import ChannelPlan
from tests.rig.live import LiveRig
from tests.rig.test_channels import BICEPS, on_both
from tests.rig.test_channels_live import CHANNELS, begun, both, step


class FakeSwitch:
    """Its faults are attributes."""

    def __init__(self) -> None:
        self.closed: set[int] = set()
        self.fault = ""
        self.told: list[str] = []

    async def open(self, on_lost: Callable[[str], None]) -> dict[str, Any]:
        self._may()
        self.lose = on_lost
        return {"device": "fake", "id": "7", "elements": 8, "channel": "biceps"}

    async def connect(self, elements: Sequence[int]) -> None:
        self._may()
        self.closed = set(elements)
        self.told.append(f"connect {sorted(elements)}")

    async def open_all(self) -> None:
        self._may()
        self.closed = set()
        self.told.append("open")

    def close(self) -> None: ...

    def _may(self) -> None:
        if self.fault:
            raise DeviceError(self.fault)


class SwitchedRig(LiveRig):
    switch: FakeSwitch

    def devices(self) -> dict[str, Any]:
        return {**super().devices(), "switch": self.switch}


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SwitchedRig]:
    settings = find("switch", "scpi_matrix").Settings(
        device="scpi_matrix", port="/dev/matrix", channel="biceps", elements=8
    )
    SwitchedRig.switch = FakeSwitch()
    SwitchedRig.switch.closed = {5}  # a process before has died
    made = SwitchedRig(tmp_path, monkeypatch, channels=CHANNELS, switch=settings)
    yield made
    made.close()


def with_elements(*elements: int) -> dict[str, Any]:
    chosen = [ChannelPlan(name="biceps", profile=BICEPS, elements=list(elements)), both()[1]]
    return {"profile": BICEPS, "channels": chosen, "segments": [on_both()]}


def test_a_test_over_the_switch(live: SwitchedRig) -> None:
    assert live.switch.closed == set(), "what was left is opened"
    assert live.rig.status().switch == {"device": "fake", "id": "7", "elements": 8, "channel": "biceps"}
    live.start(live.plan("t1", **with_elements(2, 3)))
    live.wait_pulses(3)
    assert live.switch.closed == {2, 3}
    live.wait("ready")
    assert live.switch.told == ["open", "connect [2, 3]", "open"]


def test_a_stop_opens_them(live: SwitchedRig) -> None:
    live.start(live.plan("t1", **with_elements(2)))
    live.wait_pulses(3)
    assert live.stop("x").confirmed
    assert live.switch.closed == set()


def test_after_a_stop_that_was_not_confirmed_they_are_opened_at_the_re_arm(live: SwitchedRig) -> None:
    live.start(live.plan("t1", **with_elements(2)))
    live.wait_pulses(3)
    live.stimulator.stalled = True
    assert not live.stop("x").confirmed
    live.wait("latched")
    assert live.switch.closed == {2}
    live.stimulator.stalled = False
    live.clock.wait(live.machine.tasks, 1.0)
    live.rearm()
    assert live.switch.closed == set()


def test_a_switch_that_fails_latches(live: SwitchedRig) -> None:
    live.switch.fault = "switch: no answer"
    live.start(live.plan("t1", **with_elements(2)))
    assert "switch: no answer" in live.wait("latched")
    assert live.stimulator.sent == []
    with pytest.raises(RigError, match="switch: no answer"):
        live.rearm()
    live.switch.fault = ""
    live.rearm()
    assert live.rig.status().state == "ready"


def test_a_switch_that_is_lost(live: SwitchedRig) -> None:
    live.switch.lose("switch: unplugged")
    assert live.rig.status().state == "disconnected"
    with pytest.raises(DeviceError, match="unplugged"):
        live.start(live.plan("t1", **with_elements(2)))


def test_a_calibration_over_the_switch(live: SwitchedRig) -> None:
    begun(live, channels=[{"name": "biceps", "elements": [4]}, {"name": "triceps"}])
    step(live, "biceps")
    step(live, "triceps")
    assert live.switch.told == ["open", "connect [4]", "open"]
    with pytest.raises(BusyError):
        live.start(live.plan("t1", **with_elements(2)))
