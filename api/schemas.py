"""What clients send, checked field by field; what they get is documented in docs/api.md."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StringConstraints

Code = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,32}$"),
    Field(description="a code, never a name: letters, digits, - and _, at most 32", examples=["P017"]),
]


class Body(BaseModel):
    """Base of all request bodies: unknown fields are refused, so a typing slip is seen."""

    model_config = ConfigDict(extra="forbid")


class ProfileIn(Body):
    """A participant's limits for the day; the rig's hard limits hold besides."""

    current_ma: Annotated[FiniteFloat, Field(gt=0, le=130, description="fixed current of every pulse, mA")] = 20.0
    max_pulse_width_us: Annotated[FiniteFloat, Field(gt=0, le=500, description="comfort maximum, µs")] = 300.0
    max_torque_nm: Annotated[FiniteFloat, Field(gt=0, le=200, description="torque at which a test stops, N·m")] = 30.0


class ParticipantIn(Body):
    """A new participant."""

    code: Code
    profile: ProfileIn = Field(default_factory=ProfileIn)


class SegmentIn(Body):
    """One segment of a test: a sequence of the library by name, with its settings."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    sequence: Annotated[str, StringConstraints(min_length=1, max_length=40)]
    settings: dict[str, Any] = Field(default_factory=dict)


class TestIn(Body):
    """A test to be run now."""

    __test__ = False

    participant: Code
    kind: Annotated[str, StringConstraints(pattern=r"^[a-z-]{1,40}$")] = "pre-session"
    profile: ProfileIn | None = Field(None, description="for this test alone, never wider than the participant's own")
    segments: Annotated[list[SegmentIn], Field(min_length=1, max_length=200)] | None = Field(
        None, description="None: the default pre-session test"
    )
    pulse_rate_hz: Annotated[FiniteFloat, Field(gt=0, le=100)] = 40.0
    max_pulse_width_us: (
        Annotated[FiniteFloat, Field(gt=0, description="for this test alone, if tighter, µs")] | None
    ) = None
    max_torque_nm: Annotated[FiniteFloat, Field(gt=0, description="for this test alone, if tighter, N·m")] | None = None
    joins: Annotated[str, StringConstraints(max_length=64)] | None = Field(
        None, description="a model: the new recording is joined to that model's, and both are judged together"
    )


class CalibrationIn(Body):
    """How a guided calibration goes: one current, small steps, short trains."""

    current_ma: Annotated[FiniteFloat, Field(gt=0, le=130, description="fixed current of every pulse, mA")] = 20.0
    step_us: Annotated[FiniteFloat, Field(ge=1, le=25, description="how much wider a step up is, µs")] = 10.0
    train_s: Annotated[FiniteFloat, Field(ge=0.1, le=2, description="length of a train, s")] = 1.0
    max_pulse_width_us: Annotated[FiniteFloat, Field(gt=0, le=500, description="never wider, µs")] | None = None
    max_torque_nm: Annotated[FiniteFloat, Field(gt=0, le=200, description="torque at which a train stops")] = 30.0


class StepIn(Body):
    """One train."""

    direction: Literal["up", "down", "repeat"] = "up"


class MarkIn(Body):
    """What the participant feels, or the muscle does, at the last train's width."""

    threshold: Literal["sensory", "motor", "comfort"]


class FinishIn(Body):
    """The end of a calibration."""

    discard: bool = False


class StopIn(Body):
    """A stop, with its reason."""

    reason: Annotated[str, StringConstraints(max_length=200)] = "stop pressed"


class DecisionIn(Body):
    """Why a model is approved or rejected."""

    reason: Annotated[str, StringConstraints(max_length=500)] = ""


class EffectsIn(Body):
    """Effects to add to a model."""

    effects: Annotated[list[Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,64}$")]], Field(min_length=1)]
    reason: Annotated[str, StringConstraints(max_length=500)] = ""
    force: bool = Field(False, description="add it although the evidence is against it")


class TokenIn(Body):
    """A token to be issued."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_. -]{1,80}$")]
    scopes: Annotated[list[str], Field(min_length=1)]
    expires_utc: Annotated[str, StringConstraints(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z$")] | None = None
