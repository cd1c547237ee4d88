"""Documents on the rig's Unix socket: plans, status, replies and events. `rig.requests` has what a client asks for.

These two are the only modules of `rig` that `api` imports, beside its stop key.
"""

from __future__ import annotations

import struct
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

RigState = Literal[
    "disconnected", "uncertain", "ready", "calibrating", "arming", "running", "sealing", "stopping", "latched"
]
"""`uncertain`: started after a crash during a test; the device was asked, but no person has re-armed yet.
`calibrating`: a guided calibration is open and nothing is sent; each train passes through arming, running, sealing.
`latched`: stopped after a fault or a stop, until a person re-arms."""

Threshold = Literal["sensory", "motor", "comfort"]

Direction = Literal["up", "fine", "repeat", "down"]
"""`fine`: up by the fine step, whatever `up` would do."""

TestOutcome = Literal["completed", "stopped", "fault"]

Range = Annotated[tuple[float, float], Field(strict=False)]
"""Lowest and highest; a list of two numbers in JSON and in Python."""

PASSIVE, HELD, MOVING = "passive", "held", "moving"
"""Kinds of tests with a joint's angle: without any pulse, at a held angle, with a movement."""

LONGEST_NAME = 200
"""Characters of who calibrated the angle sensor."""
SAFE_END_S = 1.0
"""Seconds without pulses with which an adaptive test ends, wherever it ends."""
AHEAD = 2
"""Pulse periods before the end of what is laid of an adaptive test: then the fixed plan's next segment is laid, and a
client is late."""
PULSE_RATES_HZ = (1.0, 60.0)
"""Least and most that any rig plays (`stimrig.rig.limits` says why)."""


def stop_socket(path: Path) -> Path:
    """Path of the stop socket of a rig that listens at `path`."""
    return path.with_name(f"{path.name}.stop")


class Message(BaseModel):
    """Base of all messages: unknown fields are refused, so that a typing error is noticed.

    Types are strict: `true` is not a current, and `"20"` is not a width.
    """

    model_config = ConfigDict(extra="forbid", strict=True)


class SegmentPlan(Message):
    """One segment of a test: a sequence of the library by name, with its settings."""

    name: str = Field(description="segment's name in the recording: rest, prbs, ramp, validate, or the user's own")
    sequence: str = Field(description="id of a sequence in rig.sequences, e.g. prbs")
    settings: dict[str, Any] = Field(default_factory=dict)


class Profile(Message):
    """A participant's limits for the day. The tighter of these and the hard limits applies.

    A guided calibration adds both thresholds and both times. They are checked at every start: all or none are given,
    0 < sensory <= motor <= comfort, set not in the future, not expired, valid for at most one day.
    """

    current_ma: float = Field(20.0, description="fixed current of every pulse, mA")
    max_pulse_width_us: float = Field(300.0, description="comfort maximum, µs")
    max_torque_nm: float = Field(30.0, description="torque at which the test stops, N·m")
    sensory_pulse_width_us: float | None = Field(default=None, description="width at which it is first felt, µs")
    motor_pulse_width_us: float | None = Field(default=None, description="width at which the muscle first moves, µs")
    set_at_utc: str | None = Field(default=None, description="when the calibration was finished, ISO 8601")
    expires_at_utc: str | None = Field(default=None, description="end of that day in the rig's time zone, ISO 8601")
    rest_between_tests_s: float | None = Field(default=None, description="shortest rest after a test's last pulse, s")
    angle_range_rad: Range | None = Field(
        default=None, description="joint angles that are comfortable today, rad; elbow: 0 is straight, flexion positive"
    )
    angle_set_at_utc: str | None = Field(
        default=None,
        description="`set_at_utc` of the `AngleCalibration` under which that range was said; None: there was none. A "
        "test with an angle is refused once the sensor was calibrated anew",
    )


class AnglePlan(Message):
    """Conditions of a test on the joint's angle; refused on a rig without an angle sensor.

    Only a test that has it is stopped by the angle: outside its range, away from its target, without a movement, or
    where the sensor gives no reliable angle.
    """

    range_rad: Range = Field(description="outside it the test stops; the profile and the rig file may be tighter, rad")
    target_rad: float | None = Field(
        default=None, description="of a held test: it starts only here, and stops at more than twice the tolerance, rad"
    )
    tolerance_rad: float = Field(default=0.09, gt=0, le=0.6, description="around the target, at the start, rad")
    still_s: float | None = Field(
        default=None, gt=0, description="of a passive or moving test: it stops after so long without a movement, s"
    )


class AdaptivePlan(Message):
    """Bounds of a test that a client extends while it plays; they hold for the whole test, beside all other limits."""

    max_duration_s: float = Field(gt=0, allow_inf_nan=False, description="longest test, its safe end included, s")
    max_torque_time_nms: float = Field(
        gt=0, allow_inf_nan=False, description="measured torque-time at which stimulation ends, N·m·s"
    )
    patience_s: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="rest that is laid for a client that is late, before the fixed plan plays on, s",
    )


class Labels(BaseModel):
    """Labels of a test: requested, sent to the rig, sealed into the recording, shown, and used to select in cohorts.

    A new one is a field here with the default None, and a title under which pages and the command line take it and show
    it; CONTRIBUTING says what follows by itself.
    """

    participant: str = Field(description="code of the participant")
    kind: str = Field(description="kind of test")


LABELS = tuple(Labels.model_fields)
LABEL_TITLES = {name: field.title for name, field in Labels.model_fields.items() if field.title}
"""Labels that a person types and reads."""


class TestPlan(Labels, Message):
    """A whole pre-session test.

    With `adaptive` the segments are a fixed plan to fall back on. Its first segment always plays. At each later
    boundary the segments play that a client has added by then (`ExtendRequest`), else the fixed plan's next one.
    """

    __test__ = False  # keeps pytest from collecting it

    test_id: str
    kind: str = "pre-session"
    profile: Profile
    segments: list[SegmentPlan] | None = Field(None, description="None: those of the protocol")
    protocol: str | None = Field(
        None, description="id in rig.protocols, for a plan without segments; None: the default"
    )
    pulse_rate_hz: float = 40.0
    max_pulse_width_us: float | None = Field(default=None, description="for this test only, if tighter, µs")
    max_torque_nm: float | None = Field(default=None, description="for this test only, if tighter, N·m")
    adaptive: AdaptivePlan | None = Field(default=None, description="the test may be extended while it plays")
    angle: AnglePlan | None = Field(default=None, description="what it asks of the joint's angle")

    @property
    def largest_us(self) -> float:
        """The comfort maximum, or this test's own limit if it is lower, µs."""
        comfort_us, asked_us = self.profile.max_pulse_width_us, self.max_pulse_width_us
        return comfort_us if asked_us is None else min(comfort_us, asked_us)

    @property
    def stopping_torque_nm(self) -> float:
        """The profile's torque at which a test stops, or this test's own limit if it is lower, N·m."""
        own_nm, asked_nm = self.profile.max_torque_nm, self.max_torque_nm
        return own_nm if asked_nm is None else min(own_nm, asked_nm)


class RecruitmentTable(Message):
    """Recruitment curve of the participant's last model: linear between the points."""

    pulse_width_us: list[float]
    torque_nm: list[float]


class Problem(Message):
    """Why a request was refused. `code` is stable; the text is for people and says how to correct it."""

    code: str = Field(
        description="busy, late, latched, latch-changed, withdrawn, uncertain, refused, rest-needed, bad-plan, "
        "disconnected, internal, …"
    )
    title: str
    detail: str


class Reply(Message):
    id: int
    ok: bool
    problem: Problem | None = None
    body: dict[str, Any] = Field(default_factory=dict)
    """status, subscribe, start, rearm, calibrate-start, -step, -mark and -stored, angle_pose: a `Status`; preview: a
    `Preview`; sequences: a `Sequences`; stop: a `StopEvidence`; withdraw: a `Withdrawn`; calibrate-finish: a
    `CalibrationResult`; extend and enough: an `Extended`."""


class CalibrationTrain(Message):
    """One train of a calibration that was played."""

    number: int
    pulse_width_us: float
    pulses: int = Field(description="pulses that were sent")
    torque_rise_nm: float | None = Field(None, description="largest change of torque from rest, N·m")


class CalibrationStatus(Message):
    """Progress of a guided calibration."""

    calibration_id: str
    participant: str
    by: str
    current_ma: float
    step_us: float
    train_s: float
    max_torque_nm: float
    large_steps: bool = Field(False, description="steps are large where no mark is near")
    last_us: dict[Threshold, float] = Field(
        default_factory=dict, description="marks of the last calibration that the steps go by, µs; empty: none"
    )
    pulse_width_us: float = Field(description="width of the last train, µs; 0 before the first")
    ceiling_us: float = Field(description="widest pulse that the limits and a marked comfort maximum allow, µs")
    ceiling_owner: str = Field(description="who set that bound")
    next_us: dict[Direction, float] = Field(
        default_factory=dict, description="width that each step would send, µs; a missing step would be refused"
    )
    marks_us: dict[Threshold, float] = Field(default_factory=dict, description="marked widths, µs")
    missing: list[Threshold] = Field(default_factory=list, description="thresholds still to be marked")
    trains: list[CalibrationTrain] = Field(default_factory=list)


class CalibrationResult(Message):
    profile: Profile | None = Field(None, description="valid until the end of the day; None: discarded")
    recordings: list[str] = Field(default_factory=list, description="one sealed recording per train")


class Calibrated(Message):
    """A calibration that is finished, and whose result waits to be stored."""

    calibration_id: str
    participant: str
    by: str = Field(description="who began it")
    result: CalibrationResult


class Bound(Message):
    """Range that this rig allows for one quantity: the hard limit, narrowed by the rig file."""

    lo: float | None = Field(None, description="None: no lower bound")
    hi: float | None = Field(None, description="None: no upper bound")
    unit: str
    owner: str = Field(description="who set it: hard limit or rig file")


class AnglePose(Message):
    """One pose of a calibration of the angle sensor."""

    angle_rad: float = Field(description="what the goniometer showed")
    raw: float = Field(description="what the sensor gave, in its unit")


class AngleCalibration(Message):
    """Two poses and what follows from them: angle_rad = direction × radians_per_unit × (raw − offset)."""

    poses: list[AnglePose]
    offset: float = Field(description="raw value of a straight arm, in the sensor's unit")
    direction: Literal[-1, 1]
    radians_per_unit: float
    by: str = Field(max_length=LONGEST_NAME)
    set_at_utc: str = Field(max_length=LONGEST_NAME)


class AngleStatus(Message):
    """The joint's angle now, as the rig's angle sensor gives it."""

    present: bool = Field(default=False, description="whether the rig file names an angle sensor")
    angle_rad: float | None = None
    velocity_rad_s: float | None = Field(default=None, description="of the last 50 ms, so 25 ms late")
    age_s: float | None = Field(default=None, description="age of the newest angle; None: there was none")
    calibrated: bool = Field(default=False, description="by two poses")
    range_rad: Range | None = Field(default=None, description="that this rig allows in a test; None: no sensor")
    problem: str = Field(default="", description="why the sensor gives nothing; empty: nothing is wrong")
    pose: AnglePose | None = Field(default=None, description="first pose of a calibration that waits for its second")
    calibration: AngleCalibration | None = None


class Status(Message):
    state: RigState
    reason: str = Field(
        "", description="why the rig is latched, uncertain or disconnected; after several stops the newest first"
    )
    latch: str = Field("", description="changes with each stop, fault and lost device; a re-arm must give it back")
    test_id: str | None = None
    participant: str | None = None
    segment: str | None = None
    elapsed_s: float = 0.0
    duration_s: float = 0.0
    stimulator: dict[str, Any] = Field(
        default_factory=dict, description="device, id, firmware, port, shortest_us (no narrower pulse is sent)"
    )
    load_cell: dict[str, Any] = Field(default_factory=dict, description="device, measured sample rate, bus")
    torque_age_s: float | None = Field(None, description="age of the newest torque sample; None: there was none")
    torque_nm: float | None = None
    angle: AngleStatus = Field(default_factory=AngleStatus)
    calibration: CalibrationStatus | None = Field(None, description="while a guided calibration is open")
    calibrated: Calibrated | None = Field(None, description="newest result, until a client has stored it")
    limits: dict[str, Bound] = Field(default_factory=dict, description="limits of this rig by name")
    require_calibration: bool | None = Field(None, description="None: unknown")
    finished: FinishedEvent | None = Field(
        None,
        description="newest one since the rig started, recovered tests included; for clients that connect later",
    )


class SequenceInfo(Message):
    """One sequence of the library."""

    id: str
    description: str
    settings: dict[str, Any] = Field(description="JSON Schema of its settings: units, ranges and defaults")


class ProtocolInfo(Message):
    """One protocol of the library."""

    id: str
    description: str
    segments: list[str] = Field(description="names, in order")
    duration_s: float = Field(description="at 40 pulses/s")


class Sequences(Message):
    """Sequences that this rig can play."""

    sequences: list[SequenceInfo]
    protocols: list[ProtocolInfo] = Field(default_factory=list, description="whole tests; the first is the default")
    default: list[SegmentPlan] = Field(description="segments of the default pre-session test")


class Preview(Message):
    duration_s: float
    charge_uc: float = Field(description="sum over pulses of width × current, one phase, µC")
    torque_time_nms: float | None = Field(None, description="estimated torque-time, N·m·s; None: there is no model")
    pulse_width_us: list[float]
    segments: list[dict[str, Any]] = Field(description="each with name, start_s, end_s")


class StopEvidence(Message):
    """Evidence whether a stop took effect: the device's answer, and the torque after it."""

    confirmed: bool
    detail: str
    last_pulse_age_s: float | None = None
    device_state: str | None = None
    pulse_may_follow: bool = Field(
        default=False, description="a pulse sent before the stop was not acknowledged and may still be felt"
    )


class Withdrawn(Message):
    withdrawn: bool = Field(description="False: it has sent a pulse already, or is over; nothing was done")


class LaidSegment(Message):
    """A segment that was played or will be."""

    name: str
    start_s: float
    end_s: float
    by: Literal["plan", "extension", "wait", "end"] = Field(
        description="wait: rest for a client that is late; end: the rest with which an adaptive test ends"
    )


class Extended(Message):
    """Scheduled part of an adaptive test, and the remainder of its bounds."""

    test_id: str
    laid: int = Field(description="pulses that are laid, those of width 0 included, without rest for a late client")
    boundary_s: float = Field(description="where they end on the test's clock, s")
    ended_by: str = Field(description="why nothing will follow: plan, enough, limit, torque_time; empty: more may")
    duration_left_s: float
    charge_left_uc: float
    torque_time_left_nms: float = Field(description="of what was measured until now")


class StateEvent(Message):
    event: Literal["state"] = "state"
    status: Status


class PulseOutcomes(Message):
    """Outcomes of the pulses since the last live event, in the order of becoming known: as sent, not as planned.

    Times are on the test's clock, s; None: it was not written, or not acknowledged. A recording has the same columns.
    """

    index: list[int]
    pulse_width_us: list[float] = Field(description="that was sent; 0: none was")
    written_time_s: list[float | None]
    acknowledged_time_s: list[float | None]
    status: list[int] = Field(description="as `/pulses/status` of a recording")


class Pause(Message):
    """The computer stood still in a test; no current flowed, and the test went on."""

    at_s: float = Field(description="when the first pulse was due that did not go out, test's clock")
    for_s: float = Field(description="until the test went on, test's clock")
    blocked_s: float = Field(description="the longest standstill in it, real seconds")
    cause: str = Field("", description="as far as the system knows it")


class LiveState(Message):
    """Where a test is, and its dose so far."""

    event: Literal["live"] = "live"
    test_id: str | None
    segment: str | None
    elapsed_s: float
    duration_s: float = Field(description="of an adaptive test: the longest that it may take")
    torque_age_s: float
    lost_samples: int
    dropped_pulses: int
    sent_pulses: int = Field(0, description="pulses sent so far")
    charge_uc: float = Field(0.0, description="their charge, one phase, µC")
    torque_time_nms: float = Field(0.0, description="torque above rest times time since the first pulse, N·m·s")
    laid: int = Field(
        0,
        description="pulses that are laid, without rest for a late client; of a test that is not adaptive all of them",
    )
    boundary_s: float = Field(0.0, description="where they end on the test's clock, s")
    ended_by: str = Field("", description="why nothing will be laid any more; empty: more may be (see `Extended`)")
    laid_segments: list[LaidSegment] = Field(default_factory=list, description="all that are laid; adaptive tests only")
    pauses: list[Pause] = Field(default_factory=list, description="all of the test so far")
    angle_rad: float | None = Field(None, description="the newest; None without a sensor, or where it gives nothing")
    velocity_rad_s: float | None = Field(None, description="of the last 50 ms, so 25 ms late")


TORQUE_ROW = struct.Struct("<dddqB")
"""A torque sample as it arrived: host's receive time (rig's clock, s), the transport's own time, torque (N·m, zero
offset not removed; NaN: no number came), the cell's counter (unwrapped; -1: it has none; a gap: samples were lost), the
stimulator's sync line (255: there is none). `stimrig.rig.signals.SAMPLE` is the same."""
ANGLE_ROW = struct.Struct("<ddd")
"""A sample of the angle: host's receive time, angle (rad), velocity (rad/s, of the 50 ms before)."""


class LiveEvent(LiveState):
    """All that is new, about 20 times per second while torque arrives. Samples are rows of numbers, base64."""

    zero_s: float = Field(description="zero of the test's clock on the rig's clock, s; when idle the rig's start")
    pulse_rate_hz: float = 1.0
    torque: str = Field(description="every torque sample, `TORQUE_ROW`")
    angle: str | None = Field(None, description="every sample of the angle, `ANGLE_ROW`; None: no sensor")
    outcomes: PulseOutcomes = PulseOutcomes(
        index=[], pulse_width_us=[], written_time_s=[], acknowledged_time_s=[], status=[]
    )

    def torque_rows(self) -> Iterator[tuple[Any, ...]]:
        """Unpack the torque samples."""
        return TORQUE_ROW.iter_unpack(b64decode(self.torque))

    def angle_rows(self) -> Iterator[tuple[float, float, float]]:
        """Unpack the samples of the angle."""
        return ANGLE_ROW.iter_unpack(b64decode(self.angle or ""))


class FinishedEvent(Message):
    event: Literal["finished"] = "finished"
    test_id: str
    outcome: TestOutcome
    reason: str = ""
    recording_path: str | None = None
    recording_id: str | None = None
    file_sha256: str | None = None
    last_sample_unix_s: float | None = Field(None, description="host's UTC when the last sample arrived")
    summary: dict[str, Any] = Field(
        default_factory=dict,
        description="duration_s, samples, lost_samples, pulses, dropped_pulses, lateness_ms {median, p99, max}, "
        "ack_delay_ms {median, p99, max}, pauses (each as `Pause`), charge_uc, torque_time_nms, ended_by, "
        "alignment {method, error_ms}, "
        "sample_rate_hz, torque_peak_nm, angle (with a sensor: samples, lost_samples, range_rad, error_ms), "
        "cpu_percent, of a test whose process died dose_is_bound (true: charge_uc, duration_s and pulses may be too "
        "high, never too low) and doubtful_pulses, warnings (sentences for people about possible errors), "
        "notes (sentences about what happened and leaves nothing in doubt)",
    )


Event = Annotated[StateEvent | LiveEvent | FinishedEvent, Field(discriminator="event")]
