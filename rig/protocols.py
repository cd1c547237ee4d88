"""The library of protocols: whole tests, each a fixed list of segments for a largest width in µs.

To add a protocol, add a function to `LIBRARY`. Its name is the protocol's id, and the first paragraph of its docstring
says what it is. `DEFAULT` is the pre-session test of a plan that names nothing else.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any

from stimrig.rig.errors import PlanError
from stimrig.rig.messages import SegmentPlan

LOWER = 0.75
CHIPS = {"min_hold_s": 0.075, "max_hold_s": 0.4, "zero_share": 0.25, "min_share": 0.12, "seed": 33}
"""Random levels in place of a PRBS. With this seed a quarter of the time is without pulses in both tests."""


def paper(_max_pulse_width_us: float) -> list[SegmentPlan]:
    """PRBS, a triangular ramp and held-out levels, with rests around them, as in the paper.

    38.7 s at 40 pulses/s; the widths are the plan's largest by themselves. PRBS (12.7 s): 7 bits, each chip lasts 4
    pulses (0.1 s). One period of 12.7 s excites 0.08 to 4.4 Hz, which covers muscles with time constants of 0.1 to
    0.6 s. About half of its pulses are at the full width. During the rest after it the torque of the slowest muscle
    falls to a few percent before the ramp (10 s) begins. Held-out levels: 7 s.
    """
    return _with_ramp([_segment("prbs")])


def levels(_max_pulse_width_us: float) -> list[SegmentPlan]:
    """Random levels, a triangular ramp and held-out levels: the paper's test without its two-level PRBS.

    38.7 s at 40 pulses/s, of which 12.7 s are levels between 12 and 100 % of the largest width, held for 3 to 16
    pulses. A PRBS shows a muscle only at rest and at full strength; random levels also show how the torque goes from
    one level to another. `two-stage` finds no segment with two levels in it.
    """
    return _with_ramp([_levels(12.7)])


def mixed(_max_pulse_width_us: float) -> list[SegmentPlan]:
    """PRBS and random levels of half the length each, a triangular ramp and held-out levels.

    38.7 s at 40 pulses/s: as `paper`, with a PRBS of 6.3 s and levels of 6.4 s. The PRBS is one whole period of 6 bits
    with the paper's chip of 4 pulses: a chip of 2 pulses would put half of its power above the 4 Hz that a muscle
    follows, and half a period of 7 bits is not balanced. It comes first, because the straight line through two levels
    says nothing of the state in which other levels would leave the muscle.
    """
    return _with_ramp([_segment("prbs", bits=6), _levels(6.4)])


def short(max_pulse_width_us: float) -> list[SegmentPlan]:
    """PRBS at two mean levels, a slow ramp and held-out levels: a third shorter than the paper's test.

    26.2 s at 40 pulses/s. A gain or a speed that changes with the level shows between the two PRBS, of which the first
    goes to three quarters of the largest width only. The ramp takes most of the time: on simulated muscles each second
    of it told more of the recruitment curve than a second of a staircase.
    """
    lower_us = float(math.floor(LOWER * max_pulse_width_us))
    chips = {"bits": 5, "clock_pulses": 4}
    return [
        _rest(0.6),
        _segment("prbs", **chips, max_pulse_width_us=lower_us),
        _segment("prbs", **chips, seed=9),
        _rest(0.8),
        _segment("ramp", up_s=5.4, down_s=5.4),
        _rest(0.8),
        _segment("validate", "multilevel", duration_s=5.0),
        _rest(2.0),
    ]


DEFAULT = "mixed"
LIBRARY: dict[str, Callable[[float], list[SegmentPlan]]] = {
    "mixed": mixed,
    "paper": paper,
    "short": short,
    "levels": levels,
}
"""By their ids, the default first."""


def segments(protocol_id: str, max_pulse_width_us: float) -> list[SegmentPlan]:
    """Segments of the protocol of that id.

    Raises PlanError: there is no protocol of that id; the message lists the known ones.
    """
    if protocol_id not in LIBRARY:
        raise PlanError(f"protocol {protocol_id!r} is unknown; use one of {', '.join(LIBRARY)}")
    return LIBRARY[protocol_id](max_pulse_width_us)


def described() -> dict[str, str]:
    words = {name: inspect.getdoc(protocol) or "" for name, protocol in LIBRARY.items()}
    return {name: " ".join(doc.partition("\n\n")[0].split()) for name, doc in words.items()}


def _with_ramp(first: list[SegmentPlan]) -> list[SegmentPlan]:
    """Return the paper's test with these segments for its PRBS."""
    ramp, held_out = _segment("ramp"), _segment("validate", "multilevel")
    return [_rest(2.0), *first, _rest(3.0), ramp, _rest(2.0), held_out, _rest(2.0)]


def _levels(duration_s: float) -> SegmentPlan:
    return _segment("levels", "multilevel", duration_s=duration_s, **CHIPS)


def _segment(name: str, sequence: str = "", /, **settings: Any) -> SegmentPlan:
    return SegmentPlan(name=name, sequence=sequence or name, settings=settings)


def _rest(duration_s: float) -> SegmentPlan:
    return _segment("rest", duration_s=duration_s)
