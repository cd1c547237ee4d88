"""Answers about models: versions, comparison, diagnosis, improving, effects, predictions, long work."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from stimrig.api.web.responses.base import Document, Problem, SegmentOut


class ParameterOut(Document):
    """An estimate: value and standard deviation in its unit."""

    value: float | None
    sd: float | None
    unit: str = ""


class CarriedEffect(Document):
    """What a new recording says of an effect of the last approved model."""

    effect: str
    name: str
    needed: bool | None = Field(description="null: undecided, since something else is missing")
    log_evidence_gain: float | None = Field(description="with it less without it; null: not compared")
    required: float = Field(description="log evidence that it must gain")
    why: str = Field(description="the reason as one word")
    reason: str


class CarriedOut(Document):
    """The structure of the last approved model on a new recording, beside the plain structure."""

    from_model_id: str = Field(description="that model")
    offered: Literal["carried", "plain"]
    why: str = Field(description="the reason as one word")
    reason: str
    still_needed: list[str]
    no_longer_needed: list[str]
    undecided: list[str] = Field(description="left out; something else is missing that may hide them")
    effects: list[CarriedEffect]


class TrackingLimits(Document):
    """How far a tracked model may move from the approved one, either way, %; 0: this is not tracked."""

    gain_percent: float
    threshold_percent: float = Field(description="of the threshold: where the curve has gone 5 % of its way")
    time_scale_percent: float


class VersionOut(Document):
    """One model version."""

    id: str
    participant: str
    recording_id: str
    parent_id: str | None = Field(description="the version it was made from")
    added_effect: str | None = Field(description="what it holds more than that one")
    carried_from_id: str | None = Field(
        None, description="the model of an earlier session whose structure this version has"
    )
    carried: CarriedOut | None = Field(None, description="what the recording said of that structure")
    method: str
    effects: list[str]
    fit_percent: float | None
    ceiling_percent: float | None = Field(description="what the noise allows, %")
    held_out_fit_percent: float | None = Field(description="null: nothing is held out, or the torque is level there")
    rms_nm: float | None
    held_out_rms_nm: float | None
    noise_sd_nm: float | None
    figures: dict[str, ParameterOut] = Field(
        {}, description="threshold, plateau, dynamics and effects; empty: stored before they were"
    )
    verdict: Literal["usable", "usable with care", "not usable", "unknown"]
    words: str = Field(description="the verdict in one sentence")
    reasons: list[str] = Field(description="what speaks against the model, worst first")
    decision: Literal["approved", "rejected"] | None
    tracking: TrackingLimits | None = Field(
        None, description="how far it may be tracked; null: not approved, or before it could be"
    )
    served: bool = Field(description="the controller gets this one")
    created_utc: str


class Place(Document):
    """A stretch that holds much of the error."""

    segment: str
    start_s: float
    end_s: float
    pulse_width_us: list[float]
    direction: Literal["rising", "falling", "held"] | None
    share_of_excess: float
    text: str = ""


class Part(Document):
    """The error's part in a class of samples."""

    label: str
    rms_nm: float | None
    share_of_excess: float


class By(Document):
    """The error split up."""

    segment: list[Part]
    level: list[Part]
    direction: list[Part]
    time: list[Part]
    frequency: list[Part]


class ComparisonOut(Document):
    """Measurement against the model's free run."""

    fit_percent: float | None
    ceiling_percent: float | None
    rms_nm: float | None
    noise_sd_nm: float | None
    by: By | None = None
    where: list[Place] = Field([])
    series: dict[str, list[JsonValue] | float | str | None] = Field(
        default={}, description="curves for drawing, thinned, by name, and `noise_band_nm`, N·m"
    )
    plain: list[str] = Field([], description="in sentences")


class MissingOut(Document):
    """An effect that the recording asks for."""

    effect: str
    probability: float | None
    rms_before_nm: float | None
    rms_after_nm: float | None
    held_out_rms_before_nm: float | None
    held_out_rms_after_nm: float | None
    confused_with: list[str]
    next_experiment: str
    parameters: dict[str, ParameterOut]


class ExperimentOut(Document):
    """The shortest test that would decide between rivals; its segments go into `POST /v1/tests`."""

    effect: str
    rivals: list[str]
    segments: list[SegmentOut]
    duration_s: float
    dose: dict[str, float]
    text: str


class FiguresOut(Document):
    """How well a model fits."""

    fit_percent: float | None = Field(None, description="best-fit, %")
    held_out_fit_percent: float | None = Field(None, description="best-fit of held-out rows, %")
    rms_nm: float | None = Field(None, description="N·m")
    held_out_rms_nm: float | None = Field(None, description="N·m")


class StepOut(FiguresOut):
    """A step of improving."""

    added: str | None = Field(description="the effect that came; null: the structure it began with")


class DiagnosisOut(Document):
    """What is missing in a model's structure."""

    structure: list[str] | None = Field(
        None, description="effects of the structure criticised, `id` or `id:form`; null: made when it was always plain"
    )
    verdict: Literal["effect_missing", "nothing_missing", "unexplained_structure"]
    noise_sd_nm: float | None = None
    base: FiguresOut | None = None
    missing: list[MissingOut]
    where: list[Place]
    experiment: ExperimentOut | None = None


class ImprovementOut(Document):
    """Effects added one by one."""

    verdict: str
    noise_sd_nm: float | None = None
    steps: list[StepOut]
    versions: list[VersionOut] = Field(description="the versions of these steps, the first one included")


class JobOut(Document):
    """Long work: how far, and how long yet."""

    id: str
    kind: str
    model_id: str | None = Field(description="of which it is; null of `fit-recordings`")
    participant: str | None = Field(description="of `fit-recordings`")
    state: Literal["running", "completed", "failed", "cancelled"]
    done: bool
    progress: float
    text: str
    elapsed_s: float
    time_left_s: float | None
    result_url: str | None
    problem: Problem | None


class SegmentSpan(Document):
    """A segment's place in a recording or a test."""

    name: str
    start_s: float
    end_s: float


class StepResponse(Document):
    """The linear part's answer to a unit step."""

    time_s: list[float]
    response: list[float] = Field(description="N·m for a step of 1 N·m")


class CurvesOut(Document):
    """Curves thinned to what a screen shows, all of one length."""

    time_s: list[float]
    torque_nm: list[float] = Field(description="measured, N·m")
    predicted_torque_nm: list[float | None] = Field(description="the model's free run, N·m")
    pulse_width_us: list[float] = Field(description="commanded, µs")
    segments: list[SegmentSpan]
    step_response: StepResponse


class PredictionOut(Document):
    """What a model says a list of pulse widths would give."""

    model_id: str
    pulse_rate_hz: float
    torque_nm: list[float] = Field(description="mean torque in each pulse's period, N·m")


class Unreachable(Document):
    """Where a reference cannot be followed."""

    begin_s: float = Field(description="from the first pulse, s")
    end_s: float
    reason: str = Field(
        description="above-plateau, below-zero, rises-too-fast, falls-too-fast, under-threshold, not-followed"
    )
    shortfall_nm: float = Field(description="the largest difference in it, N·m")


class InversionOut(Document):
    """Pulse widths for a reference torque."""

    model_id: str
    pulse_rate_hz: float
    duration_s: float
    reference_torque_nm: list[float] = Field(description="mean in each pulse's period, N·m")
    angle_rad: list[float] | None = Field(None, description="mean in each pulse's period, where one was given, rad")
    pulse_width_us: list[float] = Field(description="one for each pulse, µs")
    predicted_torque_nm: list[float] = Field(description="mean in each pulse's period, N·m above rest")
    unreachable: list[Unreachable]
    fit_percent: float | None = Field(description="where it can be reached, %; null where the reference is level")
    whole_fit_percent: float | None = Field(description="of all of it, %")
    tolerance_nm: float = Field(description="a smaller difference counts as reached, N·m")
    max_pulse_width_us: float | None = Field(description="that was held to, µs")
    max_rise_us: float | None = Field(description="from pulse to pulse that was held to, µs")
    segments: list[SegmentOut] = Field(description="a rest, the trial, a rest: for `POST /v1/tests`, kind `sequence`")
