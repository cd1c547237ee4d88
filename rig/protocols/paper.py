"""PRBS, a triangular ramp and held-out levels, with rests around them, as in the paper.

PRBS (12.7 s): 7 bits, each chip lasts 4 pulses (0.1 s). One period of 12.7 s excites 0.08 to 4.4 Hz, which covers
muscles with time constants of 0.1 to 0.6 s. About half of its pulses are at the full width. During the rest after it
the torque of the slowest muscle falls to a few percent before the ramp (10 s) begins. Held-out levels: 7 s.
"""

from __future__ import annotations

from stimrig.rig.messages import SegmentPlan


def segments(max_pulse_width_us: float) -> list[SegmentPlan]:
    """38.7 s at 40 pulses/s; the widths are the plan's largest by themselves."""
    del max_pulse_width_us
    return [
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
        SegmentPlan(name="prbs", sequence="prbs", settings={}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 3.0}),
        SegmentPlan(name="ramp", sequence="ramp", settings={}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
        SegmentPlan(name="validate", sequence="multilevel", settings={}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
    ]
