"""The library of protocols: whole tests, each a fixed list of segments for a largest width in µs.

To add a protocol, add a function to `LIBRARY`. Its name is the protocol's id, and the first paragraph of its docstring
says what it is. `DEFAULT` is the pre-session test of a plan that names nothing else.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

from stimrig.rig.errors import PlanError
from stimrig.rig.messages import ChannelSequence, SegmentPlan

LOWER = 0.75


def paper(_max_pulse_width_us: float) -> list[SegmentPlan]:
    """PRBS, a triangular ramp and held-out levels, with rests around them, as in the paper.

    38.7 s at 40 pulses/s; the widths are the plan's largest by themselves. PRBS (12.7 s): 7 bits, each chip lasts 4
    pulses (0.1 s). One period of 12.7 s excites 0.08 to 4.4 Hz, which covers muscles with time constants of 0.1 to
    0.6 s. About half of its pulses are at the full width. During the rest after it the torque of the slowest muscle
    falls to a few percent before the ramp (10 s) begins. Held-out levels: 7 s.
    """
    return [
        _rest(2.0),
        _segment("prbs"),
        _rest(3.0),
        _segment("ramp"),
        _rest(2.0),
        _segment("validate", "multilevel"),
        _rest(2.0),
    ]


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


def several(names: Sequence[str]) -> list[SegmentPlan]:
    """Random levels of all channels, a ramp of each alone, of all together, and held-out levels alone and together.

    58.0 s at 40 pulses/s with two channels: 1.5 times the paper's test. The widths are each channel's largest by
    themselves. The channels' levels are drawn apart, so that they are not correlated; the last ramps overlap by a half,
    so that every channel also moves while another one holds much or little.
    """
    turns, last = list(enumerate(names)), max(len(names) - 1, 1)
    alone = [[(name, "ramp", {"up_s": 3.3, "down_s": 3.3})] for name in names]
    together = [
        (name, "ramp", {"up_s": 2.0 + 1.4 * turn / last, "down_s": 3.2 - 1.2 * turn / last}) for turn, name in turns
    ]
    both = [(name, "multilevel", {"duration_s": 6.0, "seed": 20 + 7 * turn}) for turn, name in turns]
    own = [[(name, "multilevel", {"duration_s": 2.4, "seed": 3 + turn, "zero_share": 0.0})] for turn, name in turns]
    random = [(name, "prbs", {"seed": 1 + 41 * turn, "chips": 108}) for turn, name in turns]
    levels = [(name, "multilevel", {"duration_s": 5.0, "seed": 50 + 9 * turn}) for turn, name in turns]
    found = [_rest(2.0), _played("prbs", random), _rest(1.8)]
    for parts in alone:
        found += [_played("ramp", parts), _rest(1.2)]
    found += [_played("ramp", together), _rest(1.2), _played("levels", levels), _rest(1.4)]
    found.append(_played("validate", both))
    for parts in own:
        found += [_rest(0.9, "validate"), _played("validate", parts)]
    return [*found, _rest(2.0)]


def _played(name: str, parts: Sequence[tuple[str, str, dict[str, Any]]]) -> SegmentPlan:
    """A segment of several channels; one that is not among them rests."""
    own = {channel: ChannelSequence(sequence=sequence, settings=settings) for channel, sequence, settings in parts}
    return SegmentPlan(name=name, sequence="rest", settings={"duration_s": REST_OF_OTHERS_S}, channels=own)


REST_OF_OTHERS_S = 0.1
"""What the first channel plays where it is not named: padded to the segment's length."""
DEFAULT = "paper"
LIBRARY: dict[str, Callable[[float], list[SegmentPlan]]] = {"paper": paper, "short": short}
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


def _segment(name: str, sequence: str = "", /, **settings: Any) -> SegmentPlan:
    return SegmentPlan(name=name, sequence=sequence or name, settings=settings)


def _rest(duration_s: float, name: str = "rest") -> SegmentPlan:
    return _segment(name, "rest", duration_s=duration_s)
