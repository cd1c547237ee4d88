"""PRBS at two mean levels, a slow ramp and held-out levels: a third shorter than the paper's test.

A gain or a speed that changes with the level shows between the two PRBS, of which the first goes to three quarters of
the largest width only. The ramp takes most of the time: on simulated muscles each second of it told more of the
recruitment curve than a second of a staircase.
"""

from __future__ import annotations

import math

from stimrig.rig.messages import SegmentPlan

LOWER = 0.75


def segments(max_pulse_width_us: float) -> list[SegmentPlan]:
    """26.2 s at 40 pulses/s."""
    lower_us = float(math.floor(LOWER * max_pulse_width_us))
    chips = {"bits": 5, "clock_pulses": 4}
    return [
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 0.6}),
        SegmentPlan(name="prbs", sequence="prbs", settings={**chips, "max_pulse_width_us": lower_us}),
        SegmentPlan(name="prbs", sequence="prbs", settings={**chips, "seed": 9}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 0.8}),
        SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 5.4, "down_s": 5.4}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 0.8}),
        SegmentPlan(name="validate", sequence="multilevel", settings={"duration_s": 5.0}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
    ]
