"""What passes over the rig's Unix socket: one JSON object a line, in both directions.

A client sends a `Request` and gets one reply, a `Reply` with the same `id`. After `subscribe` the
connection also carries `Event` lines until either side closes it. `api` imports this module and
nothing else that reaches a device.

A second socket beside the first, `stop_socket`, takes `stop` alone: nothing that happens on the first one can
keep it from being heard. A request over 64 kB begins with its `kind` and `id`, as these models write it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

RigState = Literal[
    "disconnected", "uncertain", "ready", "calibrating", "arming", "running", "sealing", "stopping", "latched"
]
"""`uncertain`: started after a crash, the device has been asked but no person has re-armed.
`calibrating`: a guided calibration is open and nothing is being sent; its trains pass through arming, running, sealing.
`latched`: stopped after a fault or a stop; stays so until a person re-arms."""

Threshold = Literal["sensory", "motor", "comfort"]

Direction = Literal["up", "repeat", "down"]

TestOutcome = Literal["completed", "stopped", "fault"]


LONGEST_LINE = 1_900_000
"""Bytes of a request: the rig hears out none that is longer."""


def stop_socket(path: Path) -> Path:
    """Where a rig that listens at `path` takes stops."""
    return path.with_name(f"{path.name}.stop")


class Message(BaseModel):
    """Base of everything on the socket: unknown fields are refused, so a typing slip is seen.

    Strict: `true` is no current and `"20"` no width.
    """

    model_config = ConfigDict(extra="forbid", strict=True)


class SegmentPlan(Message):
    """One segment of a test: a sequence of the library by name, with its settings."""

    name: str = Field(description="segment's name in the recording: rest, prbs, ramp, validate, or the user's own")
    sequence: str = Field(description="id of a sequence in rig.sequences, e.g. prbs")
    settings: dict[str, Any] = Field(default_factory=dict)


class Profile(Message):
    """A participant's limits for the day; the tighter of these and the hard limits wins.

    What a guided calibration adds (both thresholds and both times, or none of them) is checked at every start:
    0 < sensory <= motor <= comfort, set not in the future, not expired, valid for a day at most.
    """

    current_ma: float = Field(20.0, description="fixed current of every pulse, mA")
    max_pulse_width_us: float = Field(300.0, description="comfort maximum, µs")
    max_torque_nm: float = Field(30.0, description="torque at which the test stops, N·m")
    sensory_pulse_width_us: float | None = Field(default=None, description="width at which it is first felt, µs")
    motor_pulse_width_us: float | None = Field(default=None, description="width at which the muscle first moves, µs")
    set_at_utc: str | None = Field(default=None, description="when the calibration was finished, ISO 8601")
    expires_at_utc: str | None = Field(default=None, description="end of that day where the rig stands, ISO 8601")
    rest_between_tests_s: float | None = Field(default=None, description="least rest from the last pulse of a test, s")


class TestPlan(Message):
    """A whole pre-session test."""

    __test__ = False  # not a test class, whatever pytest thinks of its name

    test_id: str
    participant: str
    kind: str = "pre-session"
    profile: Profile
    segments: list[SegmentPlan] | None = Field(None, description="None: the default pre-session test")
    pulse_rate_hz: float = 40.0
    max_pulse_width_us: float | None = Field(default=None, description="for this test alone, if tighter, µs")
    max_torque_nm: float | None = Field(default=None, description="for this test alone, if tighter, N·m")


class RecruitmentTable(Message):
    """A recruitment curve as the participant's last model gives it: linear between the points."""

    pulse_width_us: list[float]
    torque_nm: list[float]


class StatusRequest(Message):
    kind: Literal["status"] = "status"
    id: int = 0


class SubscribeRequest(Message):
    kind: Literal["subscribe"] = "subscribe"
    id: int = 0


class PreviewRequest(Message):
    """Ask for a plan's duration, dose and pulse widths without playing it."""

    kind: Literal["preview"] = "preview"
    id: int = 0
    plan: TestPlan
    recruitment: RecruitmentTable | None = Field(None, description="to estimate the torque-time with")


class StartRequest(Message):
    kind: Literal["start"] = "start"
    id: int = 0
    plan: TestPlan


class StopRequest(Message):
    kind: Literal["stop"] = "stop"
    id: int = 0
    reason: str
    by: str = ""


class RearmRequest(Message):
    kind: Literal["rearm"] = "rearm"
    id: int = 0
    by: str


class CalibrateStartRequest(Message):
    """Open a guided calibration; nothing is sent yet. Reply: `Status` with `calibration`."""

    kind: Literal["calibrate-start"] = "calibrate-start"
    id: int = 0
    calibration_id: str
    participant: str
    by: str
    current_ma: float = Field(20.0, description="the fixed current of all pulses, mA")
    step_us: float = Field(10.0, description="how much wider one step up is, µs")
    train_s: float = Field(1.0, description="length of the pulse train at each step, s")
    pulse_rate_hz: float = 40.0
    max_pulse_width_us: float | None = Field(None, description="never wider than this, µs; None: the hard limits alone")
    max_torque_nm: float = Field(30.0, description="torque at which a train stops, N·m")


class CalibrateStepRequest(Message):
    """Play one train: a step wider, a step narrower, or the same again. Reply: `Status`, at once (state arming).

    The train is over when the state is `calibrating` again; a fault or a stop latches and ends the calibration.
    """

    kind: Literal["calibrate-step"] = "calibrate-step"
    id: int = 0
    direction: Direction = "up"


class CalibrateMarkRequest(Message):
    """Mark the width of the last train as a threshold; marking again replaces it. Reply: `Status`."""

    kind: Literal["calibrate-mark"] = "calibrate-mark"
    id: int = 0
    threshold: Threshold


class CalibrateFinishRequest(Message):
    """Close the calibration. Reply: `CalibrationResult`, with the profile unless `discard`."""

    kind: Literal["calibrate-finish"] = "calibrate-finish"
    id: int = 0
    by: str
    discard: bool = False


Request = Annotated[
    StatusRequest
    | SubscribeRequest
    | PreviewRequest
    | StartRequest
    | StopRequest
    | RearmRequest
    | CalibrateStartRequest
    | CalibrateStepRequest
    | CalibrateMarkRequest
    | CalibrateFinishRequest,
    Field(discriminator="kind"),
]


class Problem(Message):
    """Why a request was refused; `code` is stable, the words are for people and name the mend."""

    code: str = Field(description="busy, latched, uncertain, refused, bad-plan, disconnected, internal, …")
    title: str
    detail: str


class Reply(Message):
    id: int
    ok: bool
    problem: Problem | None = None
    body: dict[str, Any] = Field(default_factory=dict)
    """status, subscribe, start, rearm, calibrate-start, -step and -mark: a `Status`; preview: a `Preview`;
    stop: a `StopEvidence`; calibrate-finish: a `CalibrationResult`."""


class CalibrationTrain(Message):
    """One train of a calibration that was played."""

    number: int
    pulse_width_us: float
    pulses: int = Field(description="how many were sent")
    torque_rise_nm: float | None = Field(None, description="highest torque above rest, either way, N·m")


class CalibrationStatus(Message):
    """Where a guided calibration stands."""

    calibration_id: str
    participant: str
    by: str
    current_ma: float
    step_us: float
    train_s: float
    max_torque_nm: float
    pulse_width_us: float = Field(description="width of the last train, µs; 0 before the first")
    ceiling_us: float = Field(description="the widest that limits and a marked comfort maximum allow, µs")
    ceiling_owner: str = Field(description="whose bound that is")
    next_us: dict[Direction, float] = Field(
        default_factory=dict, description="width that each step would send, µs; one that is missing would be refused"
    )
    marks_us: dict[Threshold, float] = Field(default_factory=dict, description="marked widths, µs")
    missing: list[Threshold] = Field(default_factory=list, description="what has to be marked before finishing")
    trains: list[CalibrationTrain] = Field(default_factory=list)


class CalibrationResult(Message):
    profile: Profile | None = Field(None, description="valid until the end of the day; None: discarded")
    recordings: list[str] = Field(default_factory=list, description="a sealed recording for each train")


class Bound(Message):
    """What this rig admits of one quantity: the hard limit, narrowed by the rig file."""

    lo: float | None = Field(None, description="None: no lower bound")
    hi: float | None = Field(None, description="None: no upper bound")
    unit: str
    owner: str = Field(description="whose bound it is: hard limit or rig file")


class Status(Message):
    state: RigState
    reason: str = Field("", description="why the rig is latched, uncertain or disconnected")
    test_id: str | None = None
    participant: str | None = None
    segment: str | None = None
    elapsed_s: float = 0.0
    duration_s: float = 0.0
    stimulator: dict[str, Any] = Field(default_factory=dict, description="device, id, firmware, port")
    load_cell: dict[str, Any] = Field(default_factory=dict, description="device, rate measured, bus")
    torque_age_s: float | None = Field(None, description="age of the newest torque sample; None: never seen")
    torque_nm: float | None = None
    calibration: CalibrationStatus | None = Field(None, description="while a guided calibration is open")
    limits: dict[str, Bound] = Field(default_factory=dict, description="this rig's limits by name")
    require_calibration: bool | None = Field(None, description="None: not told")
    finished: FinishedEvent | None = Field(
        None, description="the newest FinishedEvent since the rig started, a recovered one included: for who came late"
    )


class Preview(Message):
    duration_s: float
    charge_uc: float = Field(description="sum over pulses of width × current, one phase, µC")
    torque_time_nms: float | None = Field(
        None, description="estimated torque-time, N·m·s; None: no model to estimate with"
    )
    pulse_width_us: list[float]
    segments: list[dict[str, Any]] = Field(description="name, start_s, end_s each")


class StopEvidence(Message):
    """A stop is confirmed by its effect: what the device and the torque said after it."""

    confirmed: bool
    detail: str
    last_pulse_age_s: float | None = None
    device_state: str | None = None
    pulse_may_follow: bool = Field(
        default=False, description="one pulse was sent before the stop and not acknowledged: it may still be felt"
    )


class StateEvent(Message):
    event: Literal["state"] = "state"
    status: Status


class LiveEvent(Message):
    """About 20 a second while the load cell speaks: what a page needs to draw, no more."""

    event: Literal["live"] = "live"
    test_id: str | None
    segment: str | None
    elapsed_s: float
    duration_s: float
    time_s: list[float] = Field(description="start of each bin on the test's clock, s")
    torque_min_nm: list[float]
    torque_max_nm: list[float]
    pulse_time_s: list[float]
    pulse_width_us: list[float]
    torque_age_s: float
    lost_samples: int
    dropped_pulses: int


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
        "ack_delay_ms {median, p99, max}, "
        "charge_uc, alignment {method, error_ms}, sample_rate_hz, torque_peak_nm, cpu_percent, warnings (sentences "
        "about what is in doubt, for people)",
    )


Event = Annotated[StateEvent | LiveEvent | FinishedEvent, Field(discriminator="event")]
