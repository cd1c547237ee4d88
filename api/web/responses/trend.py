"""Answers about a participant's sessions over time."""

from __future__ import annotations

from pydantic import Field

from api.web.responses.base import Document


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
