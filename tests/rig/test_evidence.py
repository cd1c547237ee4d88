"""A stop is confirmed by the torque of now: not by what a late reader gives, nor by what falls long afterwards."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.rig.acquire.evidence import DECAY_S, NO_SIGNAL, SILENT_S, watch_decay
from stimrig.rig.messages import SegmentPlan
from tests.rig.fakes import VirtualRig, rest
from tests.simulator.virtual_time import VirtualMachine


class Heard:
    """A receiver of which the torque is always the same, after a backlog of `settles_s`."""

    def __init__(self, torque_nm: float, settles_s: float = 0.0, silent: bool = False, each_s: float = 0.001) -> None:
        self.torque_nm, self._settles_s, self._silent, self._each_s = torque_nm, settles_s, silent, each_s
        self.machine = VirtualMachine()
        self.began_s = self.machine.clock.now_s()

    def torque_around(self, _duration_s: float) -> float:
        return self.torque_nm

    def age_s(self, now_s: float) -> float:
        return math.inf if self._silent else (now_s - self.began_s) % self._each_s

    def settled(self) -> bool:
        return self.waited_s() >= self._settles_s

    def waited_s(self) -> float:
        return self.machine.clock.now_s() - self.began_s

    def confirms(self, at_stop_nm: float | None = 8.0) -> tuple[bool, str]:
        """Whether a stop, and in which words."""
        gate: Any = SimpleNamespace(last_pulse_s=self.began_s)
        receiver: Any = self
        return self.machine.run(watch_decay(gate, receiver, self.machine.tasks, 0.0, at_stop_nm))


@pytest.mark.parametrize(
    ("at_stop_nm", "now_nm", "confirmed"),
    [
        (8.0, 3.9, True), (-8.0, -3.9, True), (8.0, 4.1, False), (-8.0, -8.0, False), (6.0, -14.0, False),
        (None, 0.4, True), (None, -0.4, True), (None, 10.0, False), (None, -10.0, False),
    ],
)  # fmt: skip
def test_a_torque_far_from_its_rest_on_either_side_confirms_no_stop(
    at_stop_nm: float | None, now_nm: float, confirmed: bool
):
    assert Heard(now_nm).confirms(at_stop_nm)[0] is confirmed


@pytest.mark.parametrize(("silent", "longest_s"), [(False, DECAY_S), (True, SILENT_S)])
def test_what_a_buffer_gives_up_confirms_no_stop(silent: bool, longest_s: float):
    """Its oldest samples are of the rest before the first pulse; a cable that is out is not waited for as long."""
    endless = Heard(0.0, settles_s=math.inf, silent=silent)
    assert endless.confirms() == (False, NO_SIGNAL)
    assert endless.waited_s() == pytest.approx(longest_s, abs=0.05)


@pytest.mark.parametrize("each_s", [0.001, 0.2])
def test_a_stop_waits_while_a_backlog_is_read_also_where_samples_come_in_bursts(each_s: float):
    """A reader that a busy machine lets run each 0.2 s only is not a cable that is out."""
    late = Heard(0.0, settles_s=1.5, each_s=each_s)
    assert late.confirms()[0]
    assert late.waited_s() == pytest.approx(1.5, abs=0.1)


class HeardAfter(Heard):
    """Nothing came between 0.05 s and 0.9 s, and everything came afterwards."""

    def age_s(self, _now_s: float) -> float:
        return self.waited_s() - 0.05 if 0.05 <= self.waited_s() < 0.9 else 0.001


def test_a_stop_waits_for_the_torque_of_a_machine_that_stood_still():
    """Nobody looked while it stood still: that is no silence of the cell."""
    heard = HeardAfter(0.0, settles_s=0.9)
    clock = heard.machine.clock
    clock.call_at(heard.began_s + 0.05, lambda: clock.advance(0.8))
    assert heard.confirms()[0]
    assert heard.waited_s() == pytest.approx(0.9, abs=0.05)


def test_torque_that_falls_long_after_the_time_for_it_confirms_no_stop():
    """The looks come 60 ms late, the samples do not."""
    heard = Heard(20.0)
    heard.machine.clock.call_at(heard.began_s + 15.0, lambda: setattr(heard, "torque_nm", 0.0))
    tasks = heard.machine.tasks
    sleep = tasks.sleep
    tasks.sleep = lambda real_s: sleep(real_s + 0.06)  # pyright: ignore[reportAttributeAccessIssue]
    confirmed, _ = heard.confirms(at_stop_nm=20.0)
    assert heard.waited_s() <= 2 * DECAY_S
    assert not confirmed


@pytest.mark.slow
def test_a_reader_that_fell_behind_confirms_no_stop_by_torque_from_before_the_first_pulse(tmp_path: Path):
    """The run is stopped because samples arrive at half the rate; their torque is still that of the rest."""
    ramp = SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 1.0, "down_s": 4.0})
    rig = VirtualRig(tmp_path, [rest(2.0), ramp])
    rig.at(0.0, lambda: setattr(rig.cell, "read_share", 0.5))
    result = rig.execute()
    assert result.outcome == "fault"
    assert "samples/s arrive" in result.reason
    assert not result.evidence.confirmed
