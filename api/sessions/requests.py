"""What clients send to ask for a test, a calibration, a stop, or other limits; each field is checked."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StringConstraints, WithJsonSchema, field_validator

from api.sessions.profiles import LIMITS

Code = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,32}$"),
    Field(description="a code, never a name: letters, digits, - and _, at most 32", examples=["P017"]),
]


def _limit(name: str, description: str) -> Any:
    return Field(ge=LIMITS[name].least, le=LIMITS[name].most, description=description)


CurrentMa = Annotated[FiniteFloat, _limit("current_ma", "fixed current of every pulse, mA")]
WidthUs = Annotated[FiniteFloat, _limit("max_pulse_width_us", "comfort maximum, µs")]
TorqueNm = Annotated[FiniteFloat, _limit("max_torque_nm", "torque at which a test stops, N·m")]


class Body(BaseModel):
    """Base of all request bodies. Unknown fields are refused, so a typing slip is seen; a number is a number: neither
    `true` nor `"20"`."""

    model_config = ConfigDict(extra="forbid", strict=True)


class FirstProfileIn(Body):
    """A participant's first limits; the rig's hard limits hold besides. All of them, or none: no part is made up."""

    current_ma: CurrentMa
    max_pulse_width_us: WidthUs
    max_torque_nm: TorqueNm


FIRST_PROFILE = FirstProfileIn(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0)
"""What a participant has who was made without limits, until a person sets them or calibrates."""


class ProfileIn(Body):
    """Some of a participant's limits; one that is left out keeps its value."""

    current_ma: CurrentMa | None = None
    max_pulse_width_us: WidthUs | None = None
    max_torque_nm: TorqueNm | None = None

    @field_validator("*", mode="before")
    @classmethod
    def _no_null(cls, value: Any) -> Any:
        if value is None:
            raise ValueError("give a number, or leave the field out: then it keeps its value")
        return value

    def sent(self) -> dict[str, float]:
        """The limits that were sent."""
        return self.model_dump(exclude_unset=True)


SETTINGS = {
    "type": "object",
    "description": "with the units and ranges that `GET /v1/sequences` gives for the sequence; the rig checks them",
    "additionalProperties": {"type": ["number", "boolean", "array", "null"], "items": {"type": "number"}},
    "examples": [{"max_pulse_width_us": 250.0, "bits": 7}],
}


class SegmentIn(Body):
    """One segment of a test: a sequence of the library by name, with its settings."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,40}$"), Field(examples=["prbs"])]
    sequence: Annotated[
        str,
        StringConstraints(min_length=1, max_length=40),
        Field(description="an id of `GET /v1/sequences`", examples=["prbs"]),
    ]
    settings: Annotated[dict[str, Any], WithJsonSchema(SETTINGS)] = Field(default_factory=dict)


class TestIn(Body):
    """A test to be run now."""

    __test__ = False

    participant: Code
    kind: Annotated[str, StringConstraints(pattern=r"^[a-z-]{1,40}$")] = "pre-session"
    profile: ProfileIn | None = Field(None, description="for this test alone, never wider than the participant's own")
    segments: Annotated[list[SegmentIn], Field(min_length=1, max_length=200)] | None = Field(
        None, description="None: the default pre-session test"
    )
    pulse_rate_hz: Annotated[FiniteFloat, Field(ge=1, le=100)] = 40.0
    max_pulse_width_us: FiniteFloat | None = Field(
        None, ge=LIMITS["max_pulse_width_us"].least, description="for this test alone, if tighter, µs"
    )
    max_torque_nm: FiniteFloat | None = Field(
        None, ge=LIMITS["max_torque_nm"].least, description="for this test alone, if tighter, N·m"
    )
    joins: Annotated[str, StringConstraints(max_length=64)] | None = Field(
        None, description="a model: the new recording is joined to that model's, and both are judged together"
    )


class CalibrationIn(Body):
    """How a guided calibration goes: one current, small steps, short trains."""

    current_ma: CurrentMa | None = Field(None, description="of every pulse, mA; None: the participant's own")
    step_us: Annotated[FiniteFloat, Field(ge=1, le=25, description="how much wider a step up is, µs")] = 10.0
    train_s: Annotated[FiniteFloat, Field(ge=0.1, le=2, description="length of a train, s")] = 1.0
    max_pulse_width_us: WidthUs | None = Field(None, description="never wider, µs; None: the rig's limits alone")
    max_torque_nm: TorqueNm | None = Field(
        None, description="torque at which a train stops, and later a test, N·m; None: the participant's own"
    )


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
