"""Answers about a participant's sessions over time, and about trials that were followed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stimrig.api.web.responses.base import Document
from stimrig.api.web.responses.models import TrackingLimits


class TrendFigureOut(Document):
    """A figure of a session."""

    value: float | None = Field(description="in `unit`; null: not known, or not defined")
    sd: float | None = Field(description="standard deviation from the noise of the record; null: not known")
    uncertainty: float | None = Field(
        description="standard deviation with what repeated tests of an unchanged muscle differ by; those of two "
        "sessions add up, as squares, to that of their difference"
    )
    unit: str


class TrendNoteOut(Document):
    """What a person noted on the session."""

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
    """What changed from one session to another."""

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


class LevelOut(Document):
    """A quantity with its 95 % band."""

    value: float
    low: float
    high: float


class LevelsOut(Document):
    """What is tracked, relative to the approved model."""

    gain: LevelOut = Field(description="factor on the approved curve")
    threshold_shift_us: LevelOut = Field(description="by which the curve has moved to wider pulses, µs")
    time_scale: LevelOut = Field(description="factor on the approved time constant")


class TrialOut(Document):
    """A trial."""

    number: int = Field(description="since the approval, from 1")
    test_id: str
    recording_id: str | None
    at_utc: str = Field(description="when it was followed")
    outcome: Literal["followed", "little", "odd", "no-torque", "contradicts", "not-followed"] = Field(
        description="`little`: it tells little; `odd`: it is far from what was expected, and moves little; "
        "`contradicts`: gain, threshold and time scale do not explain it; `no-torque`: the pulses gave next to no "
        "torque, as with a loose electrode or cable; `not-followed`: `reason` says why"
    )
    reason: str
    ask: str | None = Field(description="why a new test was needed after it, in a sentence")
    error_percent: float | None = Field(description="of the torque against `reference_torque_nm`, % of its rms")
    delay_s: float | None = Field(description="from its last sample to the model being served")
    now: LevelsOut | None = Field(description="in this trial")
    coming: LevelsOut | None = Field(description="expected in the next one")
    effects: dict[str, dict[str, float]] | None = Field(
        description="by effect id, its slow state from 0 (rested) to 1: `now` at this trial's end, `coming` at the "
        "next one's begin; empty if the model has no such effect"
    )
    error_nm: float | None = Field(description="what no gain, threshold or time scale explains, N·m")
    expected_error_nm: float | None = Field(description="the same on the approved model's own recording, N·m")
    distance: float | None = Field(
        description="of what it said from what was expected, squared, in standard deviations; null: the model learnt "
        "nothing from it"
    )
    disturbed_s: list[list[float]] | None = Field(description="begin and end of stretches that do not fit, s")


class TrackingOut(Document):
    """What was tracked since the approval that holds."""

    participant: str
    approved_model_id: str
    approved_utc: str
    limits: TrackingLimits | None = Field(description="null: nobody has allowed it")
    threshold_us: float | None = Field(description="of the approved curve, µs: what the limit of the threshold is of")
    served_utc: str | None = Field(description="since when that is known which is served")
    served_trial: int | None = Field(description="the trial it was tracked to; 0: the approved model")
    etag: str | None = Field(description="of what is served with `?tracked=true`")
    ask: str | None = Field(description="why a new test is needed now, in a sentence")
    trials: list[TrialOut]
