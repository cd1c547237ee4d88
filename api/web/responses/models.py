"""Answers about models: versions, comparison, diagnosis, improving, predictions, long work, trend, trials."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, JsonValue

from stimrig.api.models.tracking import Limits
from stimrig.api.web.responses.base import Document, Problem, SegmentOut


class ParameterOut(Document):
    """An estimate."""

    value: float | None = Field(description="in `unit`; null: not known, or not defined")
    sd: float | None = Field(description="standard deviation from the noise of the record; null: not known")
    unit: str = ""


class CarriedOut(Document):
    """The structure of the last approved model on a new recording, beside the plain structure."""

    from_model_id: str = Field(description="that model")
    offered: Literal["carried", "plain"]
    why: str = Field(description="the reason as one word")
    reason: str
    still_needed: list[str]
    no_longer_needed: list[str]
    undecided: list[str] = Field(description="left out; something else is missing that may hide them")
    effects: list[dict[str, JsonValue]] = Field(
        description="of each: id, `name`, whether it is `needed` (null: undecided, since something else is missing), "
        "`log_evidence_gain` (with it less without it; null: not compared), what was `required`, `why` and `reason`"
    )


class VersionOut(Document):
    """One model version: its errors, its verdict, and where it comes from."""

    id: str
    participant: str
    recording_id: str
    parent_id: str | None = Field(description="the version it was made from")
    added_effect: str | None = Field(description="what it holds more than that one")
    carried_from_id: str | None = Field(description="the model of an earlier session whose structure this version has")
    carried: CarriedOut | None = Field(description="what the recording said of that structure")
    method: str
    effects: list[str]
    without_evidence: list[str] = Field(description="those of them that a person added without evidence")
    fit_percent: float | None
    ceiling_percent: float | None = Field(description="what the noise allows, %")
    held_out_fit_percent: float | None = Field(description="null: nothing is held out, or the torque is level there")
    rms_nm: float | None
    held_out_rms_nm: float | None
    noise_sd_nm: float | None
    figures: dict[str, ParameterOut] = Field(description="threshold, plateau, dynamics and effects")
    verdict: Literal["usable", "usable with care", "not usable", "unknown"]
    words: str = Field(description="the verdict in one sentence")
    reasons: list[str] = Field(description="what speaks against the model, worst first")
    decision: Literal["approved", "rejected"] | None
    tracking: Limits | None = Field(description="how far it may be tracked; null: not approved")
    served: bool = Field(description="the controller gets this one")
    created_utc: str


class ComparisonOut(Document):
    """Measurement against the model's free run: the schema `comparison`."""


class ExperimentOut(Document):
    """The shortest test that would decide between rivals; its segments go into `POST /v1/tests`."""

    effect: str
    rivals: list[str]
    segments: list[SegmentOut]
    duration_s: float
    dose: dict[str, float]
    text: str
    pulse_rate_hz: float = Field(40.0, description="of the recording, which its own is joined to")


class DiagnosisOut(Document):
    """Effects missing in a model's structure: the schema `diagnosis`, and the next experiment."""

    experiment: ExperimentOut | None = None


class ImprovementOut(Document):
    """Effects added one by one: the schema `improvement`, and the versions."""

    versions: list[VersionOut] = Field(description="the versions of these steps, the first one included")


class JobOut(Document):
    """Long work in the service: how far it is, how long it will take, and the address of its result."""

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


class CurvesOut(Document):
    """Curves thinned to what a screen shows, all of one length."""

    time_s: list[float]
    torque_nm: list[float] = Field(description="measured, N·m")
    predicted_torque_nm: list[float | None] = Field(description="the model's free run, N·m")
    pulse_width_us: list[float] = Field(description="commanded, µs")
    segments: list[SegmentSpan]
    step_response: dict[Literal["time_s", "response"], list[float]] = Field(
        description="of the linear part to a step of 1 N·m, N·m"
    )


class PredictionOut(Document):
    """Torque that a model predicts for a list of pulse widths."""

    model_id: str
    pulse_rate_hz: float
    torque_nm: list[float] = Field(description="mean torque in each pulse's period, N·m")


class InversionOut(Document):
    """Pulse widths for a reference torque: the schema `inversion`, and the limits that were held to."""

    model_id: str
    pulse_width_us: list[float] = Field(description="one for each pulse, µs")
    max_pulse_width_us: float | None = Field(description="that was held to, µs")
    max_rise_us: float | None = Field(description="from pulse to pulse that was held to, µs")
    shortest_pulse_us: float | None = Field(
        description="the stimulator's, µs: a narrower one is not sent, so it is 0 here; null: not known"
    )
    segments: list[SegmentOut] = Field(description="a rest, the trial, a rest: for `POST /v1/tests`, kind `sequence`")


class TrendFigureOut(ParameterOut):
    """A figure of a session."""

    uncertainty: float | None = Field(
        description="standard deviation with what repeated tests of an unchanged muscle differ by; those of two "
        "sessions add up, as squares, to that of their difference"
    )


class TrendNoteOut(Document):
    """A person's note on the session."""

    at_utc: str
    kind: str
    text: str
    by: str
    test_id: str | None = None
    at_s: float | None = Field(None, description="time in the test, s")


class TrendSessionOut(Document):
    """A session: its approved model, or its newest version where none is approved."""

    at_utc: str = Field(description="when the recording was made")
    model_id: str
    recording_id: str
    test_ids: list[str] = Field(description="the tests of that day")
    versions: int = Field(description="how many versions the session has")
    approved: bool
    approved_by: str | None
    approved_utc: str | None
    method: str
    effects: list[str]
    without_evidence: list[str] = Field(description="those of them that a person added without evidence")
    verdict: str
    figures: dict[str, TrendFigureOut] = Field(
        description="threshold_us, plateau_nm, time_constant_s, damping, delay_s, fit_percent, held_out_fit_percent, "
        "noise_sd_nm, charge_uc (of all tests of the session), current_ma, and `effect.parameter` for each effect"
    )
    notes: list[TrendNoteOut]


class DifferenceOut(Document):
    """A figure that moved by more than twice its uncertainty."""

    figure: str
    unit: str
    before: float
    now: float
    difference: float
    percent: float | None = Field(description="of the value before")
    uncertainty: float = Field(description="standard deviation of the difference")
    times: float = Field(description="the difference over its uncertainty")


class ChangesOut(Document):
    """Changes from one session to another."""

    since_utc: str = Field(description="the earlier session")
    since_model_id: str
    model_id: str
    differences: list[DifferenceOut] = Field(description="the surest first; empty: nothing changed")
    sentences: list[str]
    doubts: list[str] = Field(description="what puts the comparison in doubt: current, method, effects, notes")


class TrendOut(Document):
    """A participant's sessions, the oldest first."""

    participant: str
    sessions: list[TrendSessionOut]
    changes: ChangesOut | None = Field(
        description="the last session against the last approved one before it; null: there is none"
    )


Levels = Annotated[
    dict[Literal["gain", "threshold_shift_us", "time_scale"], dict[Literal["value", "low", "high"], float]],
    Field(
        description="with 95 % bands: factors on the approved curve and time constant; shift of the curve to wider "
        "pulses, µs"
    ),
]


class StepOut(Document):
    """Change of the muscle as estimated from one trial."""

    at_utc: str = Field(description="when it was followed")
    now: Levels | None = Field(description="in this trial")
    coming: Levels | None = Field(description="expected in the next one")
    effects: dict[str, dict[str, float]] | None = Field(
        description="by effect id, its slow state from 0 (rested) to 1: `now` at this trial's end, `coming` at the "
        "next one's begin; empty if the model has no such effect"
    )
    disturbed_s: list[list[float]] | None = Field(description="begin and end of stretches that do not fit, s")
    ask: str | None = Field(description="null, or why a new test is needed, in a sentence: a controller ends then")


class TrackedOut(StepOut):
    """Changes that a model requested with `tracked` was moved by; missing where no trial has moved it yet."""

    approved_model_id: str
    trial: int = Field(description="the trial that it was tracked to; 0: none")
    test_id: str | None
    moved: list[str] | None = Field(description="the quantities by which the model was moved")
    limits: Limits | None
    outcome: str | None


class TrialOut(StepOut):
    """A trial."""

    number: int = Field(description="since the approval, from 1")
    test_id: str
    recording_id: str | None
    outcome: Literal["followed", "little", "odd", "no-torque", "contradicts", "not-followed"] = Field(
        description="`little`: it tells little; `odd`: it is far from what was expected, and moves little; "
        "`contradicts`: gain, threshold and time scale do not explain it; `no-torque`: the pulses gave next to no "
        "torque, as with a loose electrode or cable; `not-followed`: `reason` says why"
    )
    reason: str
    error_percent: float | None = Field(description="of the torque against `reference_torque_nm`, % of its rms")
    delay_s: float | None = Field(description="from its last sample to the model being served")
    error_nm: float | None = Field(description="what no gain, threshold or time scale explains, N·m")
    expected_error_nm: float | None = Field(description="the same on the approved model's own recording, N·m")
    distance: float | None = Field(
        description="of what it said from what was expected, squared, in standard deviations; null: the model learnt "
        "nothing from it"
    )


class TrackingOut(Document):
    """Changes tracked since the valid approval."""

    participant: str
    approved_model_id: str
    approved_utc: str
    limits: Limits | None = Field(description="null: nobody has allowed it")
    threshold_us: float | None = Field(description="of the approved curve, µs: what the limit of the threshold is of")
    served_utc: str | None = Field(description="since when that is known which is served")
    served_trial: int | None = Field(description="the trial it was tracked to; 0: the approved model")
    etag: str | None = Field(description="of what is served with `?tracked=true`")
    ask: str | None = Field(description="why a new test is needed now, in a sentence")
    trials: list[TrialOut]
