"""What clients get, typed for the OpenAPI document; further fields may come with newer versions."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class Document(BaseModel):
    """Base of all answers."""

    model_config = ConfigDict(extra="allow")


class VersionOut(Document):
    """One model version."""

    id: str
    participant: str
    recording_id: str
    parent_id: str | None = Field(description="the version it was made from")
    added_effect: str | None = Field(description="what it holds more than that one")
    method: str
    effects: list[str]
    fit_percent: float | None
    ceiling_percent: float | None = Field(description="what the noise allows, %")
    held_out_fit_percent: float | None = Field(description="null: nothing is held out, or the torque is level there")
    rms_nm: float | None
    held_out_rms_nm: float | None
    noise_sd_nm: float | None
    verdict: Literal["usable", "usable with care", "not usable", "unknown"]
    words: str = Field(description="the verdict in one sentence")
    reasons: list[str] = Field(description="what speaks against the model, worst first")
    decision: Literal["approved", "rejected"] | None
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
    where: list[Place] = []
    series: dict[str, Any] = Field(default={}, description="thinned curves for drawing")
    plain: list[str] = []


class ParameterOut(Document):
    value: float | None
    sd: float | None
    unit: str = ""


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
    segments: list[dict[str, Any]]
    duration_s: float
    dose: dict[str, float]
    text: str


class DiagnosisOut(Document):
    """What is missing in a model's structure."""

    structure: list[str] | None = Field(
        None, description="effects of the structure criticised, `id` or `id:form`; null: made when it was always plain"
    )
    verdict: Literal["effect_missing", "nothing_missing", "unexplained_structure"]
    noise_sd_nm: float | None = None
    base: dict[str, Any] = {}
    missing: list[MissingOut]
    where: list[Place]
    experiment: ExperimentOut | None = None


class ImprovementOut(Document):
    """Effects added one by one."""

    verdict: str
    noise_sd_nm: float | None = None
    steps: list[dict[str, Any]]
    versions: list[VersionOut] = Field(description="the versions of these steps, the first one included")


class JobOut(Document):
    """Long work: how far, and how long yet."""

    id: str
    kind: str
    model_id: str
    state: Literal["running", "completed", "failed", "cancelled"]
    done: bool
    progress: float
    text: str
    elapsed_s: float
    time_left_s: float | None
    result_url: str | None
    problem: dict[str, Any] | None
