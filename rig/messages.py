"""What passes over the rig's Unix socket: one JSON object a line, in both directions.

A client sends a `Request` and gets one reply, a `Reply` with the same `id`. After `subscribe` the
connection also carries `Event` lines until either side closes it. `api` imports this module and
nothing else that reaches a device.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

RigState = Literal["disconnected", "uncertain", "ready", "arming", "running", "sealing", "stopping", "latched"]
"""`uncertain`: started after a crash, the device has been asked but no person has re-armed.
`latched`: stopped after a fault or a stop; stays so until a person re-arms."""

TestOutcome = Literal["completed", "stopped", "fault"]


class Message(BaseModel):
    """Base of everything on the socket: unknown fields are refused, so a typing slip is seen."""

    model_config = ConfigDict(extra="forbid")


class SegmentPlan(Message):
    """One segment of a test: a sequence of the library by name, with its settings."""

    name: str = Field(description="segment's name in the recording: rest, prbs, ramp, validate, or the user's own")
    sequence: str = Field(description="id of a sequence in rig.sequences, e.g. prbs")
    settings: dict[str, Any] = Field(default_factory=dict)


class Profile(Message):
    """A participant's limits for the day; the tighter of these and the hard limits wins."""

    current_ma: float = Field(20.0, description="fixed current of every pulse, mA")
    max_pulse_width_us: float = Field(300.0, description="comfort maximum, µs")
    max_torque_nm: float = Field(30.0, description="torque at which the test stops, N·m")


class TestPlan(Message):
    """A whole pre-session test."""

    __test__ = False  # not a test class, whatever pytest thinks of its name

    test_id: str
    participant: str
    kind: str = "pre-session"
    profile: Profile
    segments: list[SegmentPlan] | None = Field(None, description="None: the default pre-session test")
    pulse_rate_hz: float = 40.0


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


Request = Annotated[
    StatusRequest | SubscribeRequest | PreviewRequest | StartRequest | StopRequest | RearmRequest,
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
    """status, subscribe: a `Status`; preview: a `Preview`; stop: a `StopEvidence`."""


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
        "charge_uc, alignment {method, error_ms}, sample_rate_hz, torque_peak_nm, cpu_percent",
    )


Event = Annotated[StateEvent | LiveEvent | FinishedEvent, Field(discriminator="event")]
