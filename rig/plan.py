"""From a `TestPlan` to every pulse of the test. The whole test is built and checked before anything is sent.

A plan is one list of segments; each is built to a piece. A test that is extended while it plays gets more of them
later. Every limit holds for the whole test: its duration and charge, the charge of each second, and the rise from one
segment to the next.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import protocols, sequences
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import Limit, Refusal, Steps, admit, refuse
from stimrig.rig.messages import (
    HELD,
    MOVING,
    PASSIVE,
    SAFE_END_S,
    Preview,
    ProtocolInfo,
    RecruitmentTable,
    SegmentPlan,
    Sequences,
    TestPlan,
)
from stimrig.rig.signals import LaidBy, Pulse, Segment

USUAL_RATE_HZ = 40.0
MAX_SEGMENTS = 200
MAX_WIDTH_SETTING = "max_pulse_width_us"
"""If the plan does not give this setting of a sequence, it is the comfort maximum, or the request's limit if lower."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One segment, built: a width for each pulse, µs, shape (n,), n >= 1.

    `jumps` says whether its sequence may rise to any allowed width within one pulse.
    """

    of: SegmentPlan
    pulse_width_us: NDArray[np.float64]
    jumps: bool


@dataclass(frozen=True, slots=True)
class Layout:
    """Pieces one after the other: widths in µs and whether each may jump there, shape (n,), and the segments."""

    pulse_width_us: NDArray[np.float64]
    jumps: NDArray[np.bool_]
    segments: tuple[Segment, ...]

    def __len__(self) -> int:
        return len(self.pulse_width_us)

    def cut(self, end: int) -> Layout:
        segments = (s._replace(end=min(s.end, end)) for s in self.segments if s.start < end)
        return Layout(self.pulse_width_us[:end], self.jumps[:end], tuple(segments))

    def add(self, pieces: Sequence[Piece], by: LaidBy) -> Layout:
        """Return these pieces behind all others; an empty one makes no segment."""
        widths_us, jumps, segments, end = [self.pulse_width_us], [self.jumps], [*self.segments], len(self)
        for piece in pieces:
            start, end = end, end + len(piece.pulse_width_us)
            widths_us.append(piece.pulse_width_us)
            jumps.append(np.full(end - start, piece.jumps))
            segments += [Segment(piece.of.name, start, end, by)] if end > start else []
        return Layout(np.concatenate(widths_us), np.concatenate(jumps), tuple(segments))


NOTHING = Layout(np.empty(0), np.empty(0, bool), ())


@dataclass(frozen=True, slots=True)
class PlannedTest:
    """A test ready to be played."""

    plan: TestPlan
    pulse_width_us: NDArray[np.float64]
    """Width for each pulse, µs, shape (P,); pulse i is due i / pulse_rate_hz after the start."""
    segments: tuple[Segment, ...]
    pieces: tuple[Piece, ...]
    """Its segments, built; of an adaptive test those of its fixed plan, of which only the first is certain."""
    longest_s: float  # the longest that the test may take, s: its length, or the bound of an adaptive test

    @property
    def duration_s(self) -> float:
        """Length of the test, s; of an adaptive test that of its fixed plan."""
        return len(self.pulse_width_us) / self.plan.pulse_rate_hz

    @property
    def charge_uc(self) -> float:
        """Charge of one phase summed over the pulses, µC."""
        return charge_uc(self.pulse_width_us, self.plan.profile.current_ma)

    @property
    def first_pulse(self) -> int | None:
        """Index of the earliest pulse that may stimulate; None: there is none."""
        if self.plan.kind == PASSIVE:
            return None  # nor can a client add one
        first = np.flatnonzero(self.pulse_width_us)
        if self.plan.adaptive is None:
            return int(first[0]) if len(first) else None
        extended = self.segments[0].end  # the first segment that a client adds may begin here
        return min(int(first[0]), extended) if len(first) else extended


def charge_uc(widths_us: NDArray[np.float64], current_ma: float) -> float:
    """Charge of one phase summed over the pulses, µC."""
    return float(np.sum(widths_us)) * current_ma * 1e-3


def build(plan: TestPlan, table: dict[str, Limit]) -> PlannedTest:
    """Build every pulse of the plan and check it against the limits.

    `plan`: as a client sent it; `table`: limits already narrowed by the profile. Raises PlanError: unknown sequence,
    wrong setting, no segment, or a segment without a pulse: names the segment.
    """
    refuse(table["pulse_rate_hz"], plan.pulse_rate_hz, "plan")
    _check_angle(plan, table)
    chosen = plan.segments
    if chosen is None:
        protocol = protocols.DEFAULT if plan.protocol is None else plan.protocol
        plan = plan.model_copy(update={"protocol": protocol})
        chosen = protocols.segments(protocol, min(table["pulse_width_us"].hi, plan.largest_us))
    if not chosen:
        raise PlanError("plan.segments is empty; leave it out for the default test, or give at least one segment")
    if len(chosen) > MAX_SEGMENTS:
        raise PlanError(f"plan.segments: {len(chosen)} segments, at most {MAX_SEGMENTS}; combine some of them")
    built = build_pieces(chosen, plan, table["duration_s"])
    check_pieces(built, plan, table)
    layout = NOTHING.add(built, "plan")
    longest_s = len(layout) / plan.pulse_rate_hz if plan.adaptive is None else table["duration_s"].hi
    return PlannedTest(plan, layout.pulse_width_us, layout.segments, built, longest_s)


def _check_angle(plan: TestPlan, table: dict[str, Limit]) -> None:
    """Check that the kind of test has the angles it needs, and that they fit each other."""
    if plan.angle is None:
        if plan.kind in (PASSIVE, HELD, MOVING):
            raise PlanError(f"plan.angle: a {plan.kind} test needs it; give at least its range_rad")
        return
    target_rad = plan.angle.target_rad
    if plan.kind == HELD and target_rad is None:
        raise PlanError("plan.angle.target_rad: a held test needs the angle at which the joint is held")
    if target_rad is not None:
        refuse(table["angle_rad"], target_rad, "plan.angle.target_rad")


def build_pieces(chosen: Sequence[SegmentPlan], plan: TestPlan, longest: Limit, before: int = 0) -> tuple[Piece, ...]:
    """Build segments that follow `before` pulses; too long ones are refused before they are built.

    `longest`: limit on the duration of all pulses, those before included. Raises PlanError: unknown sequence, wrong
    setting, or a segment without a pulse: names the segment.
    """
    reached = before
    for number, segment in enumerate(chosen, start=1):
        with _named(number, segment):
            count = sequences.pulse_count(segment.sequence, _settings(segment, plan), plan.pulse_rate_hz)
            if count < 1:
                raise PlanError(f"too short for one pulse at {plan.pulse_rate_hz:g} pulses/s; lengthen it")
        reached += count
        refuse(longest, reached / plan.pulse_rate_hz, f"plan, up to segment {number}")
    built = []
    for number, segment in enumerate(chosen, start=1):
        with _named(number, segment):
            widths_us = sequences.build(segment.sequence, _settings(segment, plan), plan.pulse_rate_hz)
            built.append(Piece(segment, widths_us, sequences.jumps(segment.sequence, segment.settings)))
    return tuple(built)


@contextlib.contextmanager
def _named(number: int, segment: SegmentPlan) -> Iterator[None]:
    try:
        yield
    except PlanError as error:
        raise PlanError(f"segment {number} ({segment.name}): {error}") from None


def _settings(segment: SegmentPlan, plan: TestPlan) -> dict[str, object]:
    settings = dict(segment.settings)
    if MAX_WIDTH_SETTING in sequences.find(segment.sequence).Settings.model_fields:
        settings.setdefault(MAX_WIDTH_SETTING, plan.largest_us)
    return settings


def check_pieces(pieces: Sequence[Piece], plan: TestPlan, table: dict[str, Limit], before: Layout = NOTHING) -> None:
    """Check pieces against the limits, as a part of the whole that they make with what is laid before them.

    `before`: already checked. In an adaptive test a safe end must be left. Raises RefusedError: names the limit, the
    value and the excess.
    """
    current_ma, rate_hz, before_us = plan.profile.current_ma, plan.pulse_rate_hz, before.pulse_width_us
    added_us = np.concatenate([piece.pulse_width_us for piece in pieces])
    for width_us in np.unique(added_us):
        verdict = admit(Pulse(float(width_us), current_ma), table)
        if isinstance(verdict, Refusal):
            raise RefusedError(f"{_place(pieces, width_us)}: {verdict}")
    whole = len(before_us) + len(added_us)
    window = min(max(1, round(rate_hz)), whole)
    recent_us = np.concatenate([before_us[max(0, len(before_us) - window + 1) :], added_us])
    worst_uc = float(np.max(np.convolve(recent_us * current_ma * 1e-3, np.ones(window), "valid")))
    refuse(table["charge_per_second_uc"], worst_uc, "plan")
    whole_uc = charge_uc(before_us, current_ma) + charge_uc(added_us, current_ma)
    refuse(table["charge_per_test_uc"], whole_uc, "plan")
    refuse(table["duration_s"], whole / rate_hz, "plan")
    last_us = float(before_us[-1]) if len(before_us) else 0.0
    for piece in pieces:
        if not piece.jumps:  # else the sequence jumps by design
            rises_us = np.diff(piece.pulse_width_us, prepend=last_us)
            first = int(np.argmax(rises_us))
            refuse(table["width_rise_us"], float(rises_us[first]), f"segment {piece.of.name}, pulse {first + 1}")
        last_us = float(piece.pulse_width_us[-1])
    if plan.adaptive is not None:
        whole += safe_end(np.concatenate([before_us, added_us]), rate_hz)
        refuse(table["duration_s"], whole / rate_hz, "plan, with its safe end")


def _place(pieces: Sequence[Piece], width_us: float) -> str:
    """Segment and pulse at which a width stands first, NaN included."""
    for piece in pieces:
        same = (piece.pulse_width_us == width_us) | np.isnan(piece.pulse_width_us) & np.isnan(width_us)
        if same.any():
            return f"segment {piece.of.name}, pulse {int(np.argmax(same)) + 1}"
    return "plan"


def safe_end(widths_us: NDArray[np.float64], pulse_rate_hz: float) -> int:
    """Pulses of width 0 that must still follow, so that the test ends with `SAFE_END_S` without stimulation."""
    played = np.flatnonzero(widths_us)
    resting = len(widths_us) - (int(played[-1]) + 1 if len(played) else 0)
    return max(0, round(SAFE_END_S * pulse_rate_hz) - resting)


def check_steps(test: PlannedTest, steps: Steps, rise: Limit) -> None:
    """Refuse a plan whose pulses this stimulator would all round to zero, be it as they climb. Raises PlanError."""
    if not (rise.hi >= steps.shortest_us):
        raise PlanError(
            f"width_rise_us: at most {rise.hi:g} µs a pulse is allowed, and this stimulator's smallest pulse is "
            f"{steps.shortest_us:g} µs: nothing would be sent; allow more"
        )
    widest_us, current_ma = float(test.pulse_width_us.max()), test.plan.profile.current_ma
    if widest_us > 0 and (steps.width_us(widest_us) == 0 or steps.current(current_ma) == 0):
        raise PlanError(
            f"plan: {widest_us:g} µs at {current_ma:g} mA would stimulate nothing: this stimulator's smallest pulse is "
            f"{steps.shortest_us:g} µs and {steps.current_ma:g} mA"
        )


def preview(test: PlannedTest, recruitment: RecruitmentTable | None = None) -> Preview:
    """Duration, dose and pulses, to be shown before the test is played.

    Raises PlanError: the recruitment table is not a curve.
    """
    rate_hz = test.plan.pulse_rate_hz
    torque_time_nms = None
    if recruitment is not None:
        widths, torques = recruitment.pulse_width_us, recruitment.torque_nm
        if len(widths) != len(torques) or len(widths) < 2 or not np.all(np.diff(widths) > 0):
            raise PlanError("recruitment: give as many torques as pulse widths, at least two; the widths must increase")
        torque_time_nms = float(np.sum(np.interp(test.pulse_width_us, widths, torques)) / rate_hz)
    return Preview(
        duration_s=test.duration_s,
        charge_uc=test.charge_uc,
        torque_time_nms=torque_time_nms,
        pulse_width_us=test.pulse_width_us.tolist(),
        segments=[{"name": s.name, "start_s": s.start / rate_hz, "end_s": s.end / rate_hz} for s in test.segments],
    )


def library() -> Sequences:
    """All sequences with their settings as a plan gives them, all protocols, and the default test."""
    entries = sequences.described()
    for sequence in entries:
        width = sequence.settings["properties"].get(MAX_WIDTH_SETTING)
        if width is not None:
            del width["default"]
            width["description"] += "; left out: the comfort maximum, or the test's own limit if that is lower"
    described = [_protocol(name, words) for name, words in protocols.described().items()]
    return Sequences(sequences=entries, protocols=described, default=protocols.segments(protocols.DEFAULT, 0.0))


def _protocol(protocol_id: str, words: str) -> ProtocolInfo:
    chosen = protocols.segments(protocol_id, 0.0)
    pulses = sum(sequences.pulse_count(segment.sequence, segment.settings, USUAL_RATE_HZ) for segment in chosen)
    names = [segment.name for segment in chosen]
    return ProtocolInfo(id=protocol_id, description=words, segments=names, duration_s=pulses / USUAL_RATE_HZ)
