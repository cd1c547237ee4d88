"""Adaptive tests on a virtual rig: what they are made of, how they are asked, and what is left of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig.errors import RigError
from stimrig.rig.messages import AdaptivePlan, SegmentPlan
from tests.rig.fakes import VirtualRig, hold, rest

RATE_HZ = 40.0


FIXED = [rest(0.5), hold("first"), SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 0.5, "down_s": 0.5})]


def adaptive(
    folder: Path, max_duration_s: float = 10.0, max_nms: float = 1e4, fixed: list[SegmentPlan] = FIXED, **more: Any
) -> VirtualRig:
    bounds = AdaptivePlan(max_duration_s=max_duration_s, max_torque_time_nms=max_nms)
    return VirtualRig(folder, fixed, adaptive=bounds, **more)


def extend(rig: VirtualRig, after: int, segments: list[SegmentPlan]) -> None:
    """Lay segments behind pulse `after`: before the test begins, or beside its sender."""
    return rig.machine.tasks.begin(rig.run.score.extend(after, segments), "extend").result


def refusals(*requests: Callable[[], object]) -> list[RigError]:
    """What the requests raise, in order."""
    found: list[RigError] = []
    for request in requests:
        with pytest.raises(RigError) as told:
            request()
        found.append(told.value)
    return found


def widths_sent(rig: VirtualRig) -> list[int]:
    return [pulse.pulse_width_us for _, pulse in rig.stimulator.sent]
