"""Segments as pulses: built, and checked against the limits together with everything that was laid before them.

A plan is one list of segments. A test that is extended while it plays gets more of them later. Every limit holds for
the whole test: its duration and charge, the charge of each second, and the rise from one segment to the next.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import sequences
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import Limit, Refusal, admit, refuse
from stimrig.rig.messages import SAFE_END_S, SegmentPlan, TestPlan
from stimrig.rig.signals import Pulse

MAX_SEGMENTS = 200
MAX_WIDTH_SETTING = "max_pulse_width_us"
"""If the plan does not give this setting of a sequence, it is the comfort maximum, or the request's limit if lower."""
NOTHING = np.empty(0)


@dataclass(frozen=True, slots=True)
class Piece:
    """One segment, built.

    Attributes
    ----------
    pulse_width_us
        Width for each pulse, µs, shape (n,), n >= 1.
    jumps
        Whether its sequence may rise to any allowed width within one pulse.
    """

    of: SegmentPlan
    pulse_width_us: NDArray[np.float64]
    jumps: bool


def build(chosen: Sequence[SegmentPlan], plan: TestPlan, longest: Limit, before: int = 0) -> tuple[Piece, ...]:
    """Build segments that follow `before` pulses; too long ones are refused before they are built.

    Parameters
    ----------
    longest
        Limit on the duration of all pulses, those before included.

    Raises
    ------
    PlanError
        Unknown sequence, wrong setting, or a segment without a pulse: names the segment.
    RefusedError
        Too long.
    """
    reached = before
    for number, segment in enumerate(chosen, start=1):
        with _named(number, segment):
            count = sequences.pulse_count(segment.sequence, _settings(segment, plan), plan.pulse_rate_hz)
            if count < 1:
                raise PlanError(f"too short for one pulse at {plan.pulse_rate_hz:g} pulses/s; lengthen it")
        reached += count
        refuse(longest, reached / plan.pulse_rate_hz, f"plan, up to segment {number}")
    return tuple(_built(number, segment, plan) for number, segment in enumerate(chosen, start=1))


def _built(number: int, segment: SegmentPlan, plan: TestPlan) -> Piece:
    with _named(number, segment):
        widths_us = sequences.build(segment.sequence, _settings(segment, plan), plan.pulse_rate_hz)
        return Piece(segment, widths_us, sequences.jumps(segment.sequence, segment.settings))


@contextlib.contextmanager
def _named(number: int, segment: SegmentPlan) -> Iterator[None]:
    """Add the segment's number and name to a PlanError."""
    try:
        yield
    except PlanError as error:
        raise PlanError(f"segment {number} ({segment.name}): {error}") from None


def _settings(segment: SegmentPlan, plan: TestPlan) -> dict[str, object]:
    settings = dict(segment.settings)
    if MAX_WIDTH_SETTING in sequences.find(segment.sequence).Settings.model_fields:
        settings.setdefault(MAX_WIDTH_SETTING, plan.largest_us)
    return settings


def check_all(
    pieces: Sequence[Piece], plan: TestPlan, table: dict[str, Limit], before_us: NDArray[np.float64] = NOTHING
) -> None:
    """Check pieces against the limits, as a part of the whole that they make with the pulses before them.

    Parameters
    ----------
    before_us
        Widths of all pulses before them, µs, shape (n,), already checked.

    Raises
    ------
    RefusedError
        Names the limit, the value and the excess.
    """
    current_ma, rate_hz = plan.profile.current_ma, plan.pulse_rate_hz
    added_us = np.concatenate([piece.pulse_width_us for piece in pieces])
    for width_us in np.unique(added_us):
        verdict = admit(Pulse(float(width_us), current_ma), table)
        if isinstance(verdict, Refusal):
            raise RefusedError(f"{_place(pieces, width_us)}: {verdict}")
    whole = len(before_us) + len(added_us)
    window = min(max(1, round(rate_hz)), whole)
    charge_uc = np.concatenate([before_us[max(0, len(before_us) - window + 1) :], added_us]) * current_ma * 1e-3
    worst_uc = float(np.max(np.convolve(charge_uc, np.ones(window), "valid")))
    refuse(table["charge_per_second_uc"], worst_uc, "plan")
    whole_uc = sequences.dose_uc(before_us, current_ma) + sequences.dose_uc(added_us, current_ma)
    refuse(table["charge_per_test_uc"], whole_uc, "plan")
    refuse(table["duration_s"], whole / rate_hz, "plan")
    last_us = float(before_us[-1]) if len(before_us) else 0.0
    for piece in pieces:
        _check_rise(piece, last_us, table)
        last_us = float(piece.pulse_width_us[-1])


def _place(pieces: Sequence[Piece], width_us: float) -> str:
    """Segment and pulse at which a width stands first, NaN included."""
    for piece in pieces:
        same = (piece.pulse_width_us == width_us) | np.isnan(piece.pulse_width_us) & np.isnan(width_us)
        if same.any():
            return f"segment {piece.of.name}, pulse {int(np.argmax(same)) + 1}"
    return "plan"


def _check_rise(piece: Piece, before_us: float, table: dict[str, Limit]) -> None:
    """The width must not rise faster than the limit, unless the sequence jumps by design."""
    if piece.jumps:
        return
    rises_us = np.diff(piece.pulse_width_us, prepend=before_us)
    first = int(np.argmax(rises_us))
    refuse(table["width_rise_us"], float(rises_us[first]), f"segment {piece.of.name}, pulse {first + 1}")


def safe_end(widths_us: NDArray[np.float64], pulse_rate_hz: float) -> int:
    """Pulses of width 0 that must still follow, so that the test ends with `SAFE_END_S` without stimulation."""
    played = np.flatnonzero(widths_us)
    resting = len(widths_us) - (int(played[-1]) + 1 if len(played) else 0)
    return max(0, round(SAFE_END_S * pulse_rate_hz) - resting)
