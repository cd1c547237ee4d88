"""The plan of a test, with what is kept beside it; of one that stops itself its bounds, and the fixed plan.

The fixed plan plays where nobody chooses in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.sessions.requests import TestIn
from stimrig.rig.messages import SAFE_END_S, AdaptivePlan, SegmentPlan, TestPlan

ADAPTIVE = "adaptive"
"""Kind of test."""
DURATION_S = 50.0
"""The longest test, where nobody says: the opening, some ten seconds of pieces, then the whole default test fit in."""
AT_STOPPING_TORQUE_S = 12.0
"""The largest torque-time, where nobody says: so many seconds at the torque that stops the test."""
TAIL_S = 0.4
"""Silence behind the opening: when it ends, enough was measured to decide what follows."""
PIECE_S = 2.0
"""The fixed plan is cut into pieces of this length, so that a late answer costs no more."""


def bounds_of(body: TestIn, plan: TestPlan) -> AdaptivePlan:
    """Longest duration and largest torque-time of the whole test."""
    given_s, given_nm_s = body.max_duration_s, body.max_torque_time_nm_s
    return AdaptivePlan(
        max_duration_s=DURATION_S if given_s is None else given_s,
        max_torque_time_nms=AT_STOPPING_TORQUE_S * plan.stopping_torque_nm if given_nm_s is None else given_nm_s,
    )


def fixed_plan(
    opening_us: Sequence[float], default: dict[str, Any], rate_hz: float, bounds: AdaptivePlan
) -> list[SegmentPlan]:
    """The opening, then the default test in short pieces, as many as the bounds leave room for.

    Parameters
    ----------
    opening_us
        The opening's widths, one for each pulse, µs.
    default
        The rig's preview of the default test.

    Raises
    ------
    ApiError
        422: there is no room for the opening.
    """
    opening = [*opening_us, *[0.0] * round(TAIL_S * rate_hz)]
    room = round((bounds.max_duration_s - SAFE_END_S) * rate_hz) - len(opening)
    if not opening_us or room < 0:
        detail = (
            f"A test of at most {bounds.max_duration_s:g} s and {bounds.max_torque_time_nms:g} N·m·s has no room for a "
            "first look at the muscle. Nothing was started. Allow more."
        )
        raise ApiError(422, "out-of-reach", "The target cannot be reached", detail)
    found = [_segment("opening", opening)]
    for name, widths in _pieces(default, rate_hz):
        room -= len(widths)
        if room < 0:
            break
        found.append(_segment(name, widths))
    return found


def _pieces(default: dict[str, Any], rate_hz: float) -> Iterator[tuple[str, list[float]]]:
    """Name and widths of each piece, the rest at the start left out: the opening ends with one."""
    widths, most = default["pulse_width_us"], round(PIECE_S * rate_hz)
    for number, segment in enumerate(default["segments"]):
        first, end = round(segment["start_s"] * rate_hz), round(segment["end_s"] * rate_hz)
        if number or any(widths[first:end]):
            for start in range(first, end, most):
                yield segment["name"], widths[start : min(start + most, end)]


def _segment(name: str, widths: list[float]) -> SegmentPlan:
    return SegmentPlan(name=name, sequence="widths", settings={"pulse_width_us": widths, "jumps": True})


@dataclass(frozen=True)
class Planned:
    """A plan, and what else is known of it before it is played.

    Parameters
    ----------
    how, reach : dict or None
        Of an adaptive test: what it shall reach, and what it probably will.
    joint : dict or None
        Of a guided test of a joint: doses, target, longest time.
    """

    plan: TestPlan
    how: dict[str, Any] | None = None
    reach: dict[str, Any] | None = None
    joint: dict[str, Any] | None = None

    def kept(self) -> dict[str, Any]:
        """What is kept beside the plan; nothing of a test of another kind."""
        if self.joint is not None:
            return {"joint": self.joint}
        if self.how is None or self.plan.adaptive is None:
            return {}
        return {"target": self.how["target"], "reach": self.reach, "bounds": self.plan.adaptive.model_dump()}
