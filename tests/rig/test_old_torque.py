"""A stop is confirmed by the torque of now: not by what a late reader gives, nor by what falls long afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rig.acquire.evidence import DECAY_S, watch_decay
from rig.acquire.receiver import Receiver
from rig.messages import SegmentPlan
from rig.signals import TorqueBlock
from tests.rig.fakes import FakeCell, VirtualRig


def ended(tmp_path: Path) -> VirtualRig:
    rig = VirtualRig(tmp_path)
    rig.execute()
    return rig


class FallsLate:
    """Fresh, settled torque that falls `falls_s` after the first look."""

    def __init__(self, rig: VirtualRig, falls_s: float) -> None:
        self.clock, self.end_s = rig.clock, rig.clock.now_s() + falls_s

    def torque_around(self, _duration_s: float) -> float:
        return 20.0 if self.clock.now_s() < self.end_s else 0.0

    def age_s(self, _now_s: float) -> float:
        return 0.001

    def settled(self) -> bool:
        return True


def test_torque_that_falls_long_after_the_time_for_it_confirms_no_stop(tmp_path: Path):
    """The looks come 60 ms late, the samples do not."""
    rig = ended(tmp_path)
    began_s, tasks = rig.clock.now_s(), rig.machine.tasks
    sleep = tasks.sleep
    tasks.sleep = lambda real_s: sleep(real_s + 0.06)  # pyright: ignore[reportAttributeAccessIssue]
    confirmed, _ = rig.machine.run(watch_decay(rig.gate, FallsLate(rig, 15.0), tasks, 0.0, 20.0))  # pyright: ignore
    assert rig.clock.now_s() - began_s <= 2 * DECAY_S
    assert not confirmed


class Starved(FakeCell):
    """Its samples are made in time, and read at a share of their rate: the reader falls behind."""

    share = 1.0

    def feed(self, receiver: Receiver, until_s: float, per_block: int = 10) -> None:
        made: list[TorqueBlock] = []
        given, credit = 0, 0.0

        def take(block: TorqueBlock) -> None:
            nonlocal given, credit
            made.append(block)
            credit += self.share
            if credit >= 1.0:
                credit -= 1.0
                samples: Any = made[given].samples.copy()
                samples["host_time_s"] = self.clock.now_s()
                given += 1
                receiver.take(TorqueBlock(samples))

        super().feed(type("Later", (), {"take": staticmethod(take)})(), until_s, per_block)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_a_reader_that_fell_behind_confirms_no_stop_by_torque_from_before_the_first_pulse(tmp_path: Path):
    """The run is stopped because samples arrive at half the rate; their torque is still that of the rest."""
    rest = SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0})
    ramp = SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 1.0, "down_s": 4.0})
    rig = VirtualRig(tmp_path, [rest, ramp])
    rig.cell.__class__ = Starved
    rig.at(0.0, lambda: setattr(rig.cell, "share", 0.5))
    result = rig.execute()
    assert result.outcome == "fault"
    assert "samples/s arrive" in result.reason
    assert not result.evidence.confirmed
