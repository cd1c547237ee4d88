"""Size of a step of a guided calibration: large steps far from a mark, fine steps near it. Pure.

The rule in words: a step up is large until the place where the next answer is expected, and fine from there on. Where
nobody knows the participant, a large step is the widest `calibration_step_us`. Where an earlier calibration is known,
it is the wider `calibration_known_step_us`, but it never ends above what that calibration marked. A step down goes half
the way back to the next narrower train, and a step up after it goes half the way up again. No step of any kind adds
more charge to a pulse than `calibration_rise_uc`; the first train rises from nothing, and only where an earlier
calibration is known may it be more (`calibration_first_uc`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

from stimrig.rig.errors import RefusedError
from stimrig.rig.limits import Limit
from stimrig.rig.messages import Profile, Threshold
from stimrig.rig.requests import CalibrateStartRequest

FIRST_SHARE = 0.6
"""The first train's width, as a share of the last sensory threshold: too narrow to be felt, unless much has changed."""


@dataclass(frozen=True, slots=True)
class StepRule:
    """The steps of one calibration."""

    fine_us: float
    large_us: float
    known_us: float  # a large step to where an earlier calibration was
    first_us: float  # width of the first train
    last_us: Mapping[Threshold, float]  # marks of the earlier calibration; empty where none is used
    halves: bool  # whether steps down and after it go half the way; else every step is a fine one

    def up(self, width_us: float, waiting: Threshold | None, above_us: float | None) -> float:
        """Width of the next wider train.

        `width_us`: of the last train; 0 before the first. `waiting`: the threshold that is to be marked next.
        `above_us`: the narrowest wider train that a person stepped back from; None: there is none.
        """
        if width_us == 0:
            return self.first_us
        step_us = self._step_us(width_us, waiting)
        if self.halves and above_us is not None:
            step_us = min(step_us, above_us - width_us, max(self.fine_us, (above_us - width_us) / 2))
        return width_us + step_us

    def fine(self, width_us: float) -> float:
        return width_us + self.fine_us if width_us else min(self.fine_us, self.first_us)

    def down(self, width_us: float, below_us: float | None) -> float:
        """Width of the next narrower train; `below_us`: the widest one that was played and is narrower."""
        if not self.halves or below_us is None:
            return width_us - self.fine_us
        return width_us - max(self.fine_us, (width_us - below_us) / 2)

    def _step_us(self, width_us: float, waiting: Threshold | None) -> float:
        mark_us = self.last_us.get(waiting) if waiting else None
        if mark_us is None:
            return self.large_us
        goal_us = mark_us - self.fine_us if waiting == "comfort" else mark_us
        if width_us < goal_us:
            return min(self.known_us, max(self.fine_us, goal_us - width_us))
        is_near = waiting == "comfort" or width_us < mark_us + self.large_us
        return self.fine_us if is_near else self.large_us


def rule_of(request: CalibrateStartRequest, table: Mapping[str, Limit]) -> StepRule:
    """The steps that a request gets under a rig's limits; the current must have been checked.

    Raises RefusedError: the earlier calibration makes no sense.
    """
    amperes = request.current_ma * 1e-3
    rise_us = table["calibration_rise_uc"].hi / amperes
    fine_us = min(request.step_us, rise_us)
    if not request.large_steps:
        return StepRule(fine_us, fine_us, fine_us, fine_us, {}, halves=False)
    last_us = marks_of(request.last, request.current_ma)
    large_us = max(fine_us, min(table["calibration_step_us"].hi, rise_us))
    known_us = max(fine_us, min(table["calibration_known_step_us"].hi, rise_us))
    first_us = large_us
    if last_us:
        most_us = table["calibration_first_uc"].hi / amperes
        first_us = max(fine_us, min(FIRST_SHARE * last_us["sensory"], most_us))
    return StepRule(fine_us, large_us, known_us, first_us, last_us, halves=True)


def marks_of(last: Profile | None, current_ma: float) -> dict[Threshold, float]:
    """The marks of an earlier calibration, as far as they say something about this current.

    With a higher current every pulse is stronger than it was, so the old marks would be too high: none is used.

    Raises RefusedError: the marks are not above 0 and in their order, or the current is no number.
    """
    if last is None or last.sensory_pulse_width_us is None or last.motor_pulse_width_us is None:
        return {}
    marks: dict[Threshold, float] = {
        "sensory": last.sensory_pulse_width_us,
        "motor": last.motor_pulse_width_us,
        "comfort": last.max_pulse_width_us,
    }
    in_order = all(low <= high for low, high in itertools.pairwise((*marks.values(), float("1e4"))))
    if not (in_order and marks["sensory"] > 0 and last.current_ma > 0):
        raise RefusedError(
            "calibration: the marks of the earlier calibration are not above 0 and in the order sensory, motor, "
            "comfort; calibrate without them"
        )
    return marks if current_ma <= last.current_ma else {}
