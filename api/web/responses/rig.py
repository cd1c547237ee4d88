"""Answers about the rig, its tests, and the service's health."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from stimrig.api.web.responses.base import Document, Holder, ReachOut, SegmentOut
from stimrig.api.web.responses.models import SegmentSpan, VersionOut
from stimrig.rig.messages import (
    AngleStatus,
    Bound,
    CalibrationStatus,
    Labels,
    ProtocolInfo,
    RigState,
    SequenceInfo,
    StopEvidence,
)


class DeviceOut(Document):
    """A device of the rig, and how it is connected."""

    device: str = ""
    shortest_us: float | None = Field(default=None, description="of the stimulator: no narrower pulse is sent, µs")


class RigHealth(Document):
    """The rig in a few words."""

    connected: bool = Field(description="whether the rig's process answers")
    state: RigState
    age_s: float | None = Field(description="time since it last said something, s")
    torque_age_s: float | None = Field(description="age of the newest torque, s")


class RigOut(RigHealth):
    """The newest state of the rig, and its age."""

    reason: str = Field(description="why it is latched, uncertain or disconnected")
    latch: str = Field("", description="names the last stop; a re-arm sends it as `If-Match`, as the `ETag` has it")
    holder: Holder | None = Field(description="the test that holds it")
    test_id: str | None = None
    participant: str | None = None
    segment: str | None = None
    elapsed_s: float = Field(0.0, description="of the test that runs, s")
    duration_s: float = Field(0.0, description="of the test that runs, s")
    stimulator: DeviceOut = Field(DeviceOut(), description="device, id, firmware, port")
    load_cell: DeviceOut = Field(DeviceOut(), description="device, measured sample rate, bus")
    torque_nm: float | None = Field(None, description="newest torque, N·m")
    torque_age_s: float | None = Field(None, description="its age, s")
    angle: AngleStatus = Field(AngleStatus(), description="of the joint, where the rig has an angle sensor")
    calibration: CalibrationStatus | None = None
    limits: dict[str, Bound] = Field({}, description="what this rig takes, by quantity")
    require_calibration: bool | None = None


class StoppedOut(Document):
    """Stimulation has stopped."""

    stopped: Literal[True]
    evidence: StopEvidence
    rig: RigOut | None = Field(None, description="not for a controller's key: another's test may be in it")


class SequenceOut(SequenceInfo, Document):
    """A sequence that the rig can play."""

    settings: dict[str, JsonValue] = Field(description="JSON Schema that a segment's `settings` must hold to")


class SequencesOut(Document):
    """The sequences of this rig."""

    sequences: list[SequenceOut]
    protocols: list[ProtocolInfo] = Field([], description="whole tests by name; the first is the default")
    default: list[SegmentOut] = Field(description="the segments of a test that is given none")


class PlannedOut(Document):
    """Duration and dose of a test."""

    duration_s: float = Field(0.0, description="s")
    charge_uc: float = Field(0.0, description="charge of one phase, summed over the pulses, µC")
    torque_time_nms: float | None = Field(None, description="estimated torque-time, N·m·s; null without a model")
    segments: list[SegmentSpan] = Field([])


class PreviewOut(PlannedOut):
    """A test that is not played."""

    pulse_width_us: list[float] = Field(description="one for each pulse, µs; of an adaptive test its fixed plan")
    reach: ReachOut | None = Field(None, description="of an adaptive test: what it will probably reach")
    plan_hash: str = Field(description="starts just this plan: `POST /v1/tests`, within five minutes")


class TestSummary(Document):
    """The recording; empty until the test has ended."""

    __test__ = False
    duration_s: float | None = Field(None, description="s")
    samples: int | None = Field(None, description="torque samples")
    lost_samples: int | None = None
    sample_rate_hz: float | None = Field(None, description="measured, Hz")
    pulses: int | None = None
    dropped_pulses: int | None = None
    charge_uc: float | None = Field(None, description="charge of one phase, summed over the pulses, µC")
    torque_peak_nm: float | None = Field(None, description="N·m")
    warnings: list[str] = Field([], description="what is in doubt, in sentences")
    notes: list[str] = Field([], description="what happened and leaves nothing in doubt, in sentences")


class WorkOut(Document):
    """Progress of the identification."""

    verb: str = Field("fit", description="`fit`: the first model; `carry`: the structure of the last approved one")
    progress: float = Field(0.0, description="share that is done, 0 to 1")
    text: str = ""
    time_left_s: float | None = Field(None, description="null: not known yet")


class KnowledgeOut(Document):
    """The muscle as it is known by now."""

    plateau_nm: float
    curve_percent: float = Field(description="largest half-width of the curve's band, % of the plateau")
    step_percent: float = Field(description="of the step response, %")
    recruitment: dict[Literal["pulse_width_us", "torque_nm", "lower_nm", "upper_nm"], list[float]] = Field(
        description="the curve with its 95 % band as a whole"
    )
    step_response: dict[Literal["time_s", "value", "lower", "upper"], list[float]] = Field(
        description="the response to a unit step with its 95 % band as a whole"
    )


class DecisionOut(Document):
    """One answer of the worker that chooses."""

    at_s: float = Field(description="newest sample that it knew, s")
    kind: Literal["next", "enough", "misfit", "spent"]
    words: str
    segments: list[str] = Field(description="names of what was chosen")
    expected_torque_time_nm_s: float
    answer_ms: float = Field(description="from the question to the answer")
    curve_percent: float | None = Field(None, description="how well the curve was known, %; null before a fit")
    step_percent: float | None = Field(None, description="and the step response, %")
    late: bool = Field(False, description="it came too late and fell away")
    refused: str | None = Field(None, description="why the rig did not lay it; null where it did")
    sample_to_plan_ms: float | None = Field(None, description="from that sample until the rig had laid it")


class AdaptiveOut(Document):
    """A test that stops itself: how much is known, what is left, why it ended."""

    target: dict[str, float] = Field(description="`curve_percent`, `step_percent`")
    max_duration_s: float | None
    max_torque_time_nm_s: float | None
    torque_time_nm_s: float | None = Field(description="measured so far, N·m·s; null: not known")
    reach: ReachOut | None = Field(description="null: it was never begun")
    state: Literal["choosing", "fixed", "ending", "ended"] = Field(description="`fixed`: the fixed plan plays on")
    words: str = Field(description="the newest decision, in a sentence")
    problem: str = Field(description="why the fixed plan plays on; empty while segments are chosen")
    knowledge: KnowledgeOut | None = Field(description="both curves with their bands; null before the first fit")
    least_known: dict[str, float] | None = Field(description="`pulse_width_us` and `time_s` where the bands are widest")
    ended: str = Field(
        description="`known-enough`, `enough` (a person said so), `torque-time`, `time`, `limit` (of the "
        "charge, say), `fixed-rest` (the fixed plan was played to its end), `stopped` or `fault`; empty while it runs"
    )  # fmt: skip
    decisions: list[DecisionOut]


class TestOut(Labels, Document):
    """A test: how far it is; when `done`, its recording, its model and its summary."""

    __test__ = False
    id: str
    state: Literal[
        "requested", "running", "sealing", "identifying", "completed", "refused", "stopped", "fault", "failed"
    ]
    done: bool = Field(description="true in every final state")
    reason: str = Field(description="why it ended other than completed")
    segment: str | None = Field(description="what is played now")
    elapsed_s: float
    duration_s: float
    time_left_s: float
    progress: float = Field(description="share that is done, 0 to 1")
    identification: WorkOut | None
    requested_by: str
    ran_by: str = Field(description="who ran it at the rig")
    side: Literal["left", "right"] | None = Field(description="of the body, when it was begun; null: nobody has said")
    muscle: str | None = Field(description="the muscle that was stimulated, as it was called when the test was begun")
    requested_utc: str
    finished_utc: str | None
    planned: PlannedOut
    recording_id: str | None
    recording_url: str | None
    joins: str | None = Field(description="the model whose recording this one is joined to")
    model_id: str | None
    model_url: str | None
    summary: TestSummary
    adaptive: AdaptiveOut | None = Field(description="of a test that stops itself; null for another")
    joint: JointOut | None = Field(description="of a guided test of a joint that moves; null for another")
    fit: VersionOut | None = Field(description="the model's version, once it is identified")


class UploadOut(Document):
    """A recording of another tool that was taken in."""

    recording_id: str
    model: VersionOut
    warnings: list[str]


class HealthOut(Document):
    """Health of the service."""

    status: Literal["ok", "degraded"]
    database: Literal["ok"]
    rig: RigHealth
    uptime_s: float


class StretchOut(Document):
    """A stretch of angles that was not seen yet in one direction and at one speed."""

    direction: Literal["flexion", "extension"]
    speed: Literal["slow", "fast"]
    from_rad: float
    to_rad: float


class CoverageOut(Document):
    """Cells of angle and velocity that a movement has covered. Rows: fast and slow extension, still, slow and fast
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

    paper: float = Field(description="of the default test with the same limits")
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


class JointOverviewOut(Document):
    """Today's guided tests of a joint that are still open."""

    sensor: AngleStatus
    range_rad: list[float] | None = Field(description="the participant's; null: nobody has set it")
    targets: list[TargetOut] = Field(description="angles to hold, 3 to 5; none without a range, or with a small one")
    next_rad: float | None = Field(description="the next one that is open")
    tests: dict[Literal["passive", "moving"], str | None] = Field(description="today's newest that ended well")
    doses: DosesOut | None = Field(description="null without a sensor or a range")
    known: bool = Field(description="whether `doses` are N·m·s: a model is approved")
    share_of_paper: float | None = Field(description="of the default test's torque-time that all of them take, 0 to 1")
