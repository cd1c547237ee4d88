"""Answers about a joint that moves: its sensor, guided tests, what they have shown."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stimrig.api.web.responses.base import Document
from stimrig.rig.messages import AngleStatus


class AngleOut(AngleStatus, Document):
    """The joint's angle now, and how its sensor was calibrated."""


class StretchOut(Document):
    """A stretch of angles that was not seen yet in one direction and at one speed."""

    direction: Literal["flexion", "extension"]
    speed: Literal["slow", "fast"]
    from_rad: float
    to_rad: float


class CoverageOut(Document):
    """What a movement has shown: cells of angle and velocity. Rows: fast and slow extension, still, slow and fast
    flexion."""

    angle_edges_rad: list[float] = Field(description="of the columns, rad")
    velocity_edges_rad_s: list[float] = Field(description="between the rows; the outer ones are open, rad/s")
    time_s: list[list[float]] = Field(description="time in each cell, by row, s")
    asked: list[list[bool]] = Field(description="whether a cell must be seen")
    seen_s: float = Field(description="time after which a cell is seen, s")
    share: float = Field(description="of the cells that must be seen, 0 to 1")
    enough: bool = Field(description="at most a tenth is missing: the test ends")
    missing: list[StretchOut]


class DosesOut(Document):
    """Expected torque-time, N·m·s; without an approved model only good for being compared."""

    paper: float = Field(description="of the paper's test with the same limits")
    held_each: float = Field(description="of one held test")
    held: float = Field(description="of all held tests")
    moving: float
    total: float = Field(description="of the three guided tests together; never above `paper`")


class JointOut(Document):
    """A guided test of a joint that moves."""

    kind: Literal["passive", "held", "moving"]
    state: Literal["watching", "alone", "ending", "ended"] = Field(description="`alone`: nobody counts what is seen")
    problem: str
    ended: str = Field(
        description="`covered`, `enough` (a person said so), `torque-time`, `time`, `completed`, `stopped`, `fault`; "
        "empty while it runs"
    )
    range_rad: list[float] = Field(description="outside it the test stops")
    target_rad: float | None = Field(description="of a held test")
    tolerance_rad: float
    still_s: float | None = Field(None, description="without a movement for so long it stops, s")
    longest_s: float | None = Field(description="of a passive or moving test, s")
    angle_rad: float | None = Field(description="now")
    velocity_rad_s: float | None = Field(description="now, of the last 50 ms")
    torque_time_nm_s: float | None = Field(description="measured so far, passive torque included, N·m·s")
    doses: DosesOut
    known: bool = Field(description="whether `doses` are N·m·s: a model is approved")
    coverage: CoverageOut | None = Field(description="null of a held test")


class TargetOut(Document):
    """An angle to hold."""

    angle_rad: float
    done: bool = Field(description="held today")
    test_id: str | None


class NewestOut(Document):
    """Ids of today's newest tests that ended well."""

    passive: str | None
    moving: str | None


class JointOverviewOut(Document):
    """What is open of today's guided tests of a joint."""

    sensor: AngleStatus
    range_rad: list[float] | None = Field(description="the participant's; null: nobody has set it")
    targets: list[TargetOut] = Field(description="angles to hold, 3 to 5; none without a range, or with a small one")
    next_rad: float | None = Field(description="the next one that is open")
    tests: NewestOut
    doses: DosesOut | None = Field(description="null without a sensor or a range")
    known: bool = Field(description="whether `doses` are N·m·s: a model is approved")
    share_of_paper: float | None = Field(description="of the paper's torque-time that all of them take, 0 to 1")
