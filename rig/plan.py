"""From a `TestPlan` to every pulse of the test. The whole test is built and checked before anything is sent."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig import sequences
from rig.errors import PlanError, RefusedError
from rig.limits import Limit, Refusal, Steps, admit, check
from rig.messages import Preview, RecruitmentTable, SegmentPlan, Sequences, TestPlan
from rig.signals import Pulse

MAX_SEGMENTS = 200
MAX_WIDTH_SETTING = "max_pulse_width_us"
"""If the plan does not give this setting of a sequence, it is the comfort maximum, or the request's limit if lower."""


def default_segments() -> list[SegmentPlan]:
    """The pre-session test: PRBS (12.7 s), triangular ramp (10 s), held-out levels (7 s), rests around them; 38.7 s.

    PRBS: 7 bits, each chip lasts 4 pulses (0.1 s). One period of 12.7 s excites 0.08 to 4.4 Hz, which covers muscles
    with time constants of 0.1 to 0.6 s. About half of its pulses are at the full width. During the rest after it the
    torque of the slowest muscle falls to a few percent before the ramp begins.
    """
    return [
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
        SegmentPlan(name="prbs", sequence="prbs", settings={}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 3.0}),
        SegmentPlan(name="ramp", sequence="ramp", settings={}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
        SegmentPlan(name="validate", sequence="multilevel", settings={}),
        SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 2.0}),
    ]


def library() -> Sequences:
    """All sequences with their settings as a plan gives them, and the default test."""
    found = sequences.described()
    for sequence in found:
        width = sequence.settings["properties"].get(MAX_WIDTH_SETTING)
        if width is not None:
            del width["default"]
            width["description"] += "; left out: the comfort maximum, or the test's own limit if that is lower"
    return Sequences(sequences=found, default=default_segments())


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
    """

    plan: TestPlan
    pulse_width_us: NDArray[np.float64]
    segments: tuple[PlannedSegment, ...]

    @property
    def duration_s(self) -> float:
        """Length of the test, s."""
        return len(self.pulse_width_us) / self.plan.pulse_rate_hz

    @property
    def charge_uc(self) -> float:
        """Charge of one phase summed over the pulses, µC."""
        return sequences.dose_uc(self.pulse_width_us, self.plan.profile.current_ma)

    def segment_at(self, time_s: float) -> str | None:
        """Name of the segment at a time on the test's clock, None outside."""
        index = int(np.floor(time_s * self.plan.pulse_rate_hz + 1e-9))
        return next((s.name for s in self.segments if s.start <= index < s.end), None)


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
    _refuse(check(table["pulse_rate_hz"], plan.pulse_rate_hz), "plan")
    chosen = default_segments() if plan.segments is None else plan.segments
    segments = _laid_out(chosen, plan, table)
    parts: list[NDArray[np.float64]] = []
    for number, segment in enumerate(chosen, start=1):
        with _named(number, segment):
            parts.append(sequences.build(segment.sequence, _settings(segment, plan), plan.pulse_rate_hz))
    test = PlannedTest(plan, np.concatenate(parts), segments)
    _check(test, table)
    for segment, of in zip(segments, chosen, strict=True):
        _check_rise(test.pulse_width_us, segment, of, table)
    return test


def check_steps(test: PlannedTest, steps: Steps) -> None:
    """Refuse a plan whose pulses this stimulator would all round to zero. Raises PlanError."""
    widest_us, current_ma = float(test.pulse_width_us.max()), test.plan.profile.current_ma
    if widest_us > 0 and (steps.width_us(widest_us) == 0 or steps.current(current_ma) == 0):
        raise PlanError(
            f"plan: {widest_us:g} µs at {current_ma:g} mA would stimulate nothing: this stimulator's smallest pulse is "
            f"{steps.shortest_us:g} µs and {steps.current_ma:g} mA"
        )


def _laid_out(chosen: list[SegmentPlan], plan: TestPlan, table: dict[str, Limit]) -> tuple[PlannedSegment, ...]:
    """Start and end of each segment, computed without building it: too long a plan is refused before that."""
    if not chosen:
        raise PlanError("plan.segments is empty; leave it out for the default test, or give at least one segment")
    if len(chosen) > MAX_SEGMENTS:
        raise PlanError(f"plan.segments: {len(chosen)} segments, at most {MAX_SEGMENTS}; combine some of them")
    segments: list[PlannedSegment] = []
    start = 0
    for number, segment in enumerate(chosen, start=1):
        with _named(number, segment):
            count = sequences.pulse_count(segment.sequence, _settings(segment, plan), plan.pulse_rate_hz)
            if count < 1:
                raise PlanError(f"too short for one pulse at {plan.pulse_rate_hz:g} pulses/s; lengthen it")
        segments.append(PlannedSegment(segment.name, start, start + count))
        start += count
        _refuse(check(table["duration_s"], start / plan.pulse_rate_hz), f"plan, up to segment {number}")
    return tuple(segments)


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
        comfort_us, asked_us = plan.profile.max_pulse_width_us, plan.max_pulse_width_us
        settings.setdefault(MAX_WIDTH_SETTING, comfort_us if asked_us is None else min(comfort_us, asked_us))
    return settings


def _check(test: PlannedTest, table: dict[str, Limit]) -> None:
    current_ma, rate_hz = test.plan.profile.current_ma, test.plan.pulse_rate_hz
    for width_us in np.unique(test.pulse_width_us):
        verdict = admit(Pulse(float(width_us), current_ma), table)
        if isinstance(verdict, Refusal):
            same = (test.pulse_width_us == width_us) | np.isnan(test.pulse_width_us) & np.isnan(width_us)
            first = int(np.argmax(same))
            segment = next(s for s in test.segments if s.start <= first < s.end)
            raise RefusedError(f"segment {segment.name}, pulse {first - segment.start + 1}: {verdict}")
    charge_uc = test.pulse_width_us * current_ma * 1e-3
    window = min(max(1, round(rate_hz)), len(charge_uc))
    worst_uc = float(np.max(np.convolve(charge_uc, np.ones(window), "valid")))
    _refuse(check(table["charge_per_second_uc"], worst_uc), "plan")
    _refuse(check(table["charge_per_test_uc"], test.charge_uc), "plan")


def _check_rise(
    widths_us: NDArray[np.float64], segment: PlannedSegment, of: SegmentPlan, table: dict[str, Limit]
) -> None:
    """The width must not rise faster than the limit, unless the sequence jumps by design."""
    if sequences.jumps(of.sequence, of.settings):
        return
    before_us = widths_us[segment.start - 1] if segment.start else 0.0
    rises_us = np.diff(widths_us[segment.start : segment.end], prepend=before_us)
    first = int(np.argmax(rises_us))
    refusal = check(table["width_rise_us"], float(rises_us[first]))
    _refuse(refusal, f"segment {segment.name}, pulse {first + 1}")


def _refuse(refusal: Refusal | None, place: str) -> None:
    if refusal is not None:
        raise RefusedError(f"{place}: {refusal}")


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
