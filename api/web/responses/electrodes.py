"""Answers about searches for an array's electrode."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stimrig.api.web.responses.base import Document


class ExpectedOut(Document):
    """What is believed of a quantity."""

    mean: float
    sd: float


class ChoiceOut(Document):
    """An element or a pair on the map."""

    elements: list[int]
    stimulated: bool
    torque_nm: ExpectedOut = Field(description="positive in the wanted direction, N·m")
    spill: ExpectedOut = Field(description="0 none, 1 slight, 2 strong")
    comfort: ExpectedOut = Field(description="0 unbearable, 10 unnoticed")
    utility: ExpectedOut = Field(description="torque that is left when the wish's prices are paid, N·m")


class ProposalOut(Document):
    """What to stimulate next."""

    elements: list[int]
    why: str
    expected: float = Field(description="utility, N·m")
    sd: float


class EnoughOut(Document):
    """Why no further stimulus is worth it."""

    reason: str
    elements: list[int] | None = Field(description="null: no element gives what is wished")
    probability: float


class StimulusOut(Document):
    """One stimulus, and what was seen of it."""

    test_id: str
    elements: list[int]
    state: str = Field(description="of its test")
    spill: Literal["none", "slight", "strong"] | None
    comfort: float | None = Field(description="null: not told")
    torque_nm: float | None
    by: str | None = Field(description="who told it")
    at_utc: str | None


class SearchOut(Document):
    """A search over an array."""

    id: str
    participant: str
    channel: str
    state: Literal["open", "enough", "closed"]
    wish: str
    direction: str
    width_us: float
    current_ma: float
    rows: int
    columns: int
    pitch_mm: float
    stimuli: list[StimulusOut]
    playing: bool
    waiting: str | None = Field(description="test that was played and not told yet")
    proposal: ProposalOut
    enough: EnoughOut | None = Field(description="null: go on")
    best: list[int] | None = Field(description="of those that were stimulated")
    sure: float | None = Field(description="probability that the best is within 10 % of the best of all")
    map: list[ChoiceOut]
    left_out: list[list[int]] = Field(description="stopped while they were stimulated: not proposed")
    chosen: list[int] | None
    prior: bool = Field(description="whether a former search is known")
    created_by: str
    created_utc: str
    closed_by: str | None
    closed_utc: str | None
