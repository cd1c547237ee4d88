"""From a `TestPlan` to every pulse of the test. The whole test is built and checked before anything is sent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import pieces, protocols, sequences
from stimrig.rig.errors import PlanError
from stimrig.rig.limits import Limit, Steps, refuse
from stimrig.rig.messages import HELD, MOVING, PASSIVE, Preview, ProtocolInfo, RecruitmentTable, Sequences, TestPlan
from stimrig.rig.pieces import MAX_SEGMENTS, MAX_WIDTH_SETTING, Piece

USUAL_RATE_HZ = 40.0


def library() -> Sequences:
    """All sequences with their settings as a plan gives them, all protocols, and the default test."""
    found = sequences.described()
    for sequence in found:
        width = sequence.settings["properties"].get(MAX_WIDTH_SETTING)
        if width is not None:
            del width["default"]
            width["description"] += "; left out: the comfort maximum, or the test's own limit if that is lower"
    default = protocols.segments(protocols.DEFAULT, 0.0)
    told = [_protocol(name, words) for name, words in protocols.described().items()]
    return Sequences(sequences=found, protocols=told, default=default)


def _protocol(protocol_id: str, words: str) -> ProtocolInfo:
    chosen = protocols.segments(protocol_id, 0.0)
    pulses = sum(sequences.pulse_count(segment.sequence, segment.settings, USUAL_RATE_HZ) for segment in chosen)
    names = [segment.name for segment in chosen]
    return ProtocolInfo(id=protocol_id, description=words, segments=names, duration_s=pulses / USUAL_RATE_HZ)


@dataclass(frozen=True, slots=True)
class PlannedSegment:
    """A segment as indices of its pulses, end exclusive."""

    name: str
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class PlannedTest:
    """A test ready to be played.

    Attributes
    ----------
    pulse_width_us
        Width for each pulse, µs, shape (P,); pulse i is due i / pulse_rate_hz after the start.
    pieces
        Its segments, built; of an adaptive test those of its fixed plan, of which only the first is certain.
    longest_s
        The longest that the test may take, s: its length, or the bound of an adaptive test.
    """

    plan: TestPlan
    pulse_width_us: NDArray[np.float64]
    segments: tuple[PlannedSegment, ...]
    pieces: tuple[Piece, ...]
    longest_s: float

    @property
    def duration_s(self) -> float:
        """Length of the test, s; of an adaptive test that of its fixed plan."""
        return len(self.pulse_width_us) / self.plan.pulse_rate_hz

    @property
    def charge_uc(self) -> float:
        """Charge of one phase summed over the pulses, µC."""
        return sequences.dose_uc(self.pulse_width_us, self.plan.profile.current_ma)

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


def build(plan: TestPlan, table: dict[str, Limit]) -> PlannedTest:
    """Build every pulse of the plan and check it against the limits.

    Parameters
    ----------
    plan
        As a client sent it.
    table
        Limits already narrowed by the profile.

    Raises
    ------
    PlanError
        Unknown sequence, wrong setting, no segment, or a segment without a pulse: names the segment.
    RefusedError
        The plan would break a limit: names the limit, the pulse and the excess.
    """
    refuse(table["pulse_rate_hz"], plan.pulse_rate_hz, "plan")
    _check_angle(plan, table)
    chosen = plan.segments
    if chosen is None:
        chosen = protocols.segments(plan.protocol, min(table["pulse_width_us"].hi, plan.largest_us))
    if not chosen:
        raise PlanError("plan.segments is empty; leave it out for the default test, or give at least one segment")
    if len(chosen) > MAX_SEGMENTS:
        raise PlanError(f"plan.segments: {len(chosen)} segments, at most {MAX_SEGMENTS}; combine some of them")
    built = pieces.build(chosen, plan, table["duration_s"])
    pieces.check_all(built, plan, table)
    widths_us = np.concatenate([piece.pulse_width_us for piece in built])
    longest_s = len(widths_us) / plan.pulse_rate_hz
    if plan.adaptive is not None:
        # it plays if nobody extends: it must fit into its bounds with its safe end
        whole = len(widths_us) + pieces.safe_end(widths_us, plan.pulse_rate_hz)
        refuse(table["duration_s"], whole / plan.pulse_rate_hz, "plan, with its safe end")
        longest_s = table["duration_s"].hi
    return PlannedTest(plan, widths_us, laid_out(built), built, longest_s)


def _check_angle(plan: TestPlan, table: dict[str, Limit]) -> None:
    """What a kind of test needs of the angle, and whether its angles fit each other."""
    if plan.angle is None:
        if plan.kind in (PASSIVE, HELD, MOVING):
            raise PlanError(f"plan.angle: a {plan.kind} test needs it; give at least its range_rad")
        return
    target_rad = plan.angle.target_rad
    if plan.kind == HELD and target_rad is None:
        raise PlanError("plan.angle.target_rad: a held test needs the angle at which the joint is held")
    if target_rad is not None:
        refuse(table["angle_rad"], target_rad, "plan.angle.target_rad")


def laid_out(built: Sequence[Piece]) -> tuple[PlannedSegment, ...]:
    """Start and end of each piece."""
    ends = np.cumsum([len(piece.pulse_width_us) for piece in built]).tolist()
    starts = [0, *ends[:-1]]
    return tuple(PlannedSegment(piece.of.name, *at) for piece, *at in zip(built, starts, ends, strict=True))


def check_steps(test: PlannedTest, steps: Steps) -> None:
    """Refuse a plan whose pulses this stimulator would all round to zero. Raises PlanError."""
    widest_us, current_ma = float(test.pulse_width_us.max()), test.plan.profile.current_ma
    if widest_us > 0 and (steps.width_us(widest_us) == 0 or steps.current(current_ma) == 0):
        raise PlanError(
            f"plan: {widest_us:g} µs at {current_ma:g} mA would stimulate nothing: this stimulator's smallest pulse is "
            f"{steps.shortest_us:g} µs and {steps.current_ma:g} mA"
        )


def preview(test: PlannedTest, recruitment: RecruitmentTable | None = None) -> Preview:
    """Duration, dose and pulses, to be shown before the test is played.

    Raises
    ------
    PlanError
        The recruitment table is not a curve.
    """
    rate_hz = test.plan.pulse_rate_hz
    torque_time_nms = None
    if recruitment is not None:
        widths, torques = recruitment.pulse_width_us, recruitment.torque_nm
        if len(widths) != len(torques) or len(widths) < 2 or not np.all(np.diff(widths) > 0):
            raise PlanError("recruitment: give as many torques as pulse widths, at least two; the widths must increase")
        torque_time_nms = sequences.torque_time_nms(test.pulse_width_us, rate_hz, widths, torques)
    return Preview(
        duration_s=test.duration_s,
        charge_uc=test.charge_uc,
        torque_time_nms=torque_time_nms,
        pulse_width_us=test.pulse_width_us.tolist(),
        segments=[{"name": s.name, "start_s": s.start / rate_hz, "end_s": s.end / rate_hz} for s in test.segments],
    )
