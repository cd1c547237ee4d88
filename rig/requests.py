"""Requests on the rig's Unix socket, one JSON object per line; each is answered by one `messages.Reply` of its `id`.

After `subscribe` the connection also carries `Event` lines until either side closes it. A second socket, `stop_socket`,
accepts only `stop`, so that nothing on the first socket can delay a stop. A request over 64 kB must begin with its
`kind` and `id`, as these models write it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from stimrig.rig.messages import (
    LONGEST_NAME,
    Direction,
    Message,
    Profile,
    RecruitmentTable,
    SegmentPlan,
    TestPlan,
    Threshold,
)

LONGEST_LINE = 1_900_000
"""Bytes of a request. The rig refuses longer ones."""


class _Request(Message):
    """Base of all requests, written with kind and id first."""

    kind: Any
    id: int = 0


class StatusRequest(_Request):
    kind: Literal["status"] = "status"


class SubscribeRequest(_Request):
    kind: Literal["subscribe"] = "subscribe"


class PreviewRequest(_Request):
    """Ask for a plan's duration, dose and pulse widths; nothing is sent."""

    kind: Literal["preview"] = "preview"
    plan: TestPlan
    recruitment: RecruitmentTable | None = Field(None, description="to estimate the torque-time")


class SequencesRequest(_Request):
    """Ask for the library of sequences, and for the default test. Reply: `Sequences`."""

    kind: Literal["sequences"] = "sequences"


class StartRequest(_Request):
    kind: Literal["start"] = "start"
    plan: TestPlan
    key: str = Field(
        default="", description="of an adaptive test: only who knows it may extend it; it is stored nowhere"
    )


class ExtendRequest(_Request):
    """Add segments to the running adaptive test, behind everything that is laid. Reply: `Extended`.

    They pass the checks of a plan, as a part of the whole test. All are laid, or none.
    """

    kind: Literal["extend"] = "extend"
    test_id: str
    key: str = Field(description="of the test's start")
    after: int = Field(description="`LiveEvent.laid` that the client saw; refused as late if more was laid since")
    segments: list[SegmentPlan] = Field(description="none: this client chooses no more, and the fixed plan plays on")


class EnoughRequest(_Request):
    """End the running adaptive test well, with its safe end; anyone may ask, like for a stop. Reply: `Extended`."""

    kind: Literal["enough"] = "enough"
    test_id: str
    by: str = ""
    at_once: bool = Field(default=False, description="at the next pulse; else where the segment that plays ends")


class WithdrawRequest(_Request):
    """Withdraw a test whose conditions have changed: it plays no pulse, and nothing latches. Reply: `Withdrawn`.

    It waits for nothing, and holds for a test that the rig has not heard of yet: its start is refused (`withdrawn`).
    """

    kind: Literal["withdraw"] = "withdraw"
    test_id: str
    reason: str
    begun: bool = Field(
        default=False, description="end it also after its first pulse; else one that has begun plays on"
    )


class StopRequest(_Request):
    kind: Literal["stop"] = "stop"
    reason: str
    by: str = ""


class RearmRequest(_Request):
    """A person has looked. Refused with `latch-changed` unless `latch` is what the status tells now."""

    kind: Literal["rearm"] = "rearm"
    by: str
    latch: str = Field(description="`Status.latch` that the person was shown")


class CalibrateStartRequest(_Request):
    """Open a guided calibration; nothing is sent yet. Reply: `Status` with `calibration`."""

    kind: Literal["calibrate-start"] = "calibrate-start"
    calibration_id: str
    participant: str
    by: str
    current_ma: float = Field(20.0, description="fixed current of all pulses, mA")
    step_us: float = Field(10.0, description="increase of the pulse width per (fine) step, µs")
    large_steps: bool = Field(
        False, description="large steps that become fine near a mark; the rig decides their width"
    )
    last: Profile | None = Field(None, description="what the participant's last calibration found; with large_steps")
    train_s: float = Field(1.0, description="length of each pulse train, s")
    pulse_rate_hz: float = 40.0
    max_pulse_width_us: float | None = Field(None, description="widest pulse allowed, µs; None: the hard limits")
    max_torque_nm: float = Field(30.0, description="torque at which a train stops, N·m")


class CalibrateStepRequest(_Request):
    """Play one train: wider, narrower, or the same again. Reply: `Status`, at once (state arming).

    The train has ended when the state is `calibrating` again. A fault or a stop latches and ends the calibration.
    """

    kind: Literal["calibrate-step"] = "calibrate-step"
    direction: Direction = "up"
    shown_us: float | None = Field(
        None, description="width that a person was shown; refused if another one would be sent. None: not shown"
    )


class CalibrateMarkRequest(_Request):
    """Mark the width of the last train as a threshold; a new mark replaces the old one. Reply: `Status`."""

    kind: Literal["calibrate-mark"] = "calibrate-mark"
    threshold: Threshold


class CalibrateFinishRequest(_Request):
    """Close the calibration. Reply: `CalibrationResult`, with the profile unless `discard`.

    The result waits in `Status.calibrated` until it is stored (`CalibrateStoredRequest`), discarded, or its day ends.
    Finishing that calibration again gives it again.
    """

    kind: Literal["calibrate-finish"] = "calibrate-finish"
    by: str
    discard: bool = False
    calibration_id: str = Field(default="", description="refused if another one is open; empty: whichever is open")


class CalibrateStoredRequest(_Request):
    """The result of a calibration is stored: the rig lets it go, if it still waits. Reply: `Status`."""

    kind: Literal["calibrate-stored"] = "calibrate-stored"
    calibration_id: str


class AnglePoseRequest(_Request):
    """Tell the angle that a goniometer shows while the joint is held still. Reply: `Status` with `angle`.

    The first pose begins a calibration of the angle sensor, the second, at least 0.5 rad away, completes it. The next
    one begins a new calibration; the old one holds until that is complete, too.
    """

    kind: Literal["angle_pose"] = "angle_pose"
    angle_rad: float = Field(description="elbow: 0 is straight, flexion positive, rad")
    by: str = Field(max_length=LONGEST_NAME, description="it stands in every status and recording from then on")
    first: bool = Field(False, description="begin anew: a first pose that waits for its second is forgotten")


Request = Annotated[
    StatusRequest
    | SubscribeRequest
    | PreviewRequest
    | SequencesRequest
    | StartRequest
    | ExtendRequest
    | EnoughRequest
    | WithdrawRequest
    | StopRequest
    | RearmRequest
    | CalibrateStartRequest
    | CalibrateStepRequest
    | CalibrateMarkRequest
    | CalibrateFinishRequest
    | CalibrateStoredRequest
    | AnglePoseRequest,
    Field(discriminator="kind"),
]
