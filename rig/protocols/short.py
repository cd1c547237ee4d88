"""A staircase, PRBS at two mean levels, a ramp and held-out levels: a third shorter than the paper's test.

The staircase shows the steady torque at each level, up and down. A gain or a speed that changes with the level shows
between the two PRBS, of which the first goes to 60 % of the largest width only.
"""

from __future__ import annotations

import math

from rig.messages import SegmentPlan

LOWER = 0.6


def segments(max_pulse_width_us: float) -> list[SegmentPlan]:
    """26.1 s at 40 pulses/s."""
    lower_us = float(math.floor(LOWER * max_pulse_width_us))
    chips = {"bits": 5, "clock_pulses": 4}
    return [
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.0}),
        SegmentPlan(name="staircase", sequence="staircase", settings={"levels": 5, "hold_s": 0.5}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.0}),
        SegmentPlan(name="prbs", sequence="prbs", settings={**chips, "max_pulse_width_us": lower_us}),
        SegmentPlan(name="prbs", sequence="prbs", settings={**chips, "seed": 9}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.4}),
        SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 2.0, "down_s": 2.0}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.0}),
        SegmentPlan(name="validate", sequence="multilevel", settings={"duration_s": 5.0}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.5}),
    ]
