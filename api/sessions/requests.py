"""Request bodies for tests, calibrations, stops and limits; each field is checked."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    StrictBool,
    StringConstraints,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from stimrig.api.errors import ApiError
from stimrig.api.models.tracking import Limits
from stimrig.api.people import accounts
from stimrig.api.people.auth import Scope
from stimrig.api.schemas.shared import SETTINGS, NoteKind
from stimrig.api.sessions import profiles
from stimrig.api.sessions.profiles import LIMITS, RANGE
from stimrig.rig.messages import HELD, LABELS, MOVING, PASSIVE, PULSE_RATES_HZ, Labels, Profile

LONGEST_NOTE = 500
RateHz = Annotated[FiniteFloat, Field(ge=PULSE_RATES_HZ[0], le=PULSE_RATES_HZ[1], description="pulses a second, Hz")]
Side = Literal["left", "right"]


def _plain(text: str) -> str:
    """A text in one line: composed (NFC), without signs that steer a display and are not seen."""
    plain = unicodedata.normalize("NFC", text).strip()
    odd = next((sign for sign in plain if unicodedata.category(sign) in UNSEEN), None)
    if odd is not None:
        raise ValueError(f"the character U+{ord(odd):04X} cannot stand in it; write one line of plain text")
    return plain


UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Kinds of characters: control and format (writing direction among them), and what is no character."""
Muscle = Annotated[
    str,
    StringConstraints(min_length=1, max_length=60),
    AfterValidator(_plain),
    Field(description="the muscle that is stimulated", examples=["biceps brachii"]),
]
PersonName = Annotated[str, StringConstraints(min_length=1, max_length=320), AfterValidator(accounts.written_name)]
PARTICIPANT_CODE = r"[A-Za-z0-9_-]{1,32}"
Code = Annotated[
    str,
    StringConstraints(pattern=f"^{PARTICIPANT_CODE}$"),
    Field(description="a code, never a name: letters, digits, - and _, at most 32", examples=["P017"]),
]


def _limit(name: str, description: str) -> Any:
    return Field(ge=LIMITS[name].lowest, le=LIMITS[name].highest, description=description)


CurrentMa = Annotated[FiniteFloat, _limit("current_ma", "fixed current of every pulse, mA")]
WidthUs = Annotated[FiniteFloat, _limit("max_pulse_width_us", "comfort maximum, µs")]
TorqueNm = Annotated[FiniteFloat, _limit("max_torque_nm", "torque at which a test stops, N·m")]
AngleRad = Annotated[FiniteFloat, Field(ge=profiles.LEAST_RAD, le=profiles.MOST_RAD)]
RangeRad = Annotated[
    tuple[AngleRad, AngleRad],
    AfterValidator(profiles.rising_range),
    Field(strict=False, description="lowest and highest joint angle, rad; elbow: 0 is straight, flexion is positive"),
]
ReferenceNm = Annotated[FiniteFloat, Field(ge=-LIMITS["max_torque_nm"].highest, le=LIMITS["max_torque_nm"].highest)]


class Body(BaseModel):
    """Base of all request bodies. Unknown fields are refused, so a typing slip is seen; a number is a number: neither
    `true` nor `"20"`."""

    model_config = ConfigDict(extra="forbid", strict=True)


UNCHANGED: Any = None
"""Default of a limit that keeps its value where it is left out; null is refused as no number."""


class ProfileIn(Body):
    """Some of a participant's limits; one that is left out keeps its value. First ones are all set, or none."""

    current_ma: CurrentMa = UNCHANGED
    max_pulse_width_us: WidthUs = UNCHANGED
    max_torque_nm: TorqueNm = UNCHANGED
    angle_range_rad: RangeRad | None = Field(default=None, description="null: the participant has none any more")

    def sent(self) -> dict[str, Any]:
        """Return the sent limits in the form of a profile."""
        return self.model_dump(mode="json", exclude_unset=True)


FIRST_PROFILE = ProfileIn(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0)
"""Limits of a new participant until a person sets them or calibrates."""


class SegmentIn(Body):
    """One segment of a test: a sequence of the library by name, with its settings."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,40}$"), Field(examples=["prbs"])]
    sequence: Annotated[
        str,
        StringConstraints(min_length=1, max_length=40),
        Field(description="an id of `GET /v1/sequences`", examples=["prbs"]),
    ]
    settings: Annotated[dict[str, Any], WithJsonSchema(SETTINGS)] = Field(default_factory=dict)


LEAST_PERCENT, MOST_PERCENT = 0.2, 50.0
"""As `stimrig.identify.experiments.knowledge` has them; named here, too, so that the service need not load it."""
Percent = Annotated[FiniteFloat, Field(ge=LEAST_PERCENT, le=MOST_PERCENT)]


class TargetIn(Body):
    """Target of a test that stops itself: half-widths of the 95 % bands of whole curves, %."""

    curve_percent: Percent = Field(default=2.0, description="of the recruitment curve, % of its plateau")
    step_percent: Percent = Field(default=2.0, description="of the response to a unit step, %")


class AngleIn(Body):
    """Conditions on the angle in a test of a joint that moves, beside the participant's range."""

    target_rad: AngleRad | None = Field(
        default=None, description="kind `held`: the angle to hold; null: the next one that is open"
    )
    still_s: FiniteFloat | None = Field(
        default=None, ge=1, le=60, description="kinds `passive`, `moving` and `sequence`: the test stops after so long "
        "without a movement, s; null: 8, 5 and never"
    )  # fmt: skip


CHOSEN_PLAN = {"segments", "protocol", "joins"}
FIELDS_OF: dict[str, set[str]] = {
    "adaptive": {"target", "max_duration_s", "max_torque_time_nm_s", "anyway"},
    "sequence": {"reference_torque_nm", "angle", *CHOSEN_PLAN},
    PASSIVE: {"angle", "max_duration_s"},
    HELD: {"angle"},
    MOVING: {"angle", "max_duration_s", "max_torque_time_nm_s"},
}
"""Fields that only tests of some kinds have; the kinds that are not named have a chosen plan alone."""


class TestIn(Labels, Body):
    """A test to be run now."""

    __test__ = False

    participant: Code
    plan_hash: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")] | None = Field(
        default=None, description="starts the plan of `POST /v1/preview` with this hash; sent with participant alone"
    )
    kind: Annotated[str, StringConstraints(pattern=r"^[a-z-]{1,40}$")] = "pre-session"
    profile: ProfileIn | None = Field(
        default=None, description="for this test alone, never wider than the participant's own"
    )
    segments: Annotated[list[SegmentIn], Field(min_length=1, max_length=200)] | None = Field(
        default=None, description="None: those of the protocol"
    )
    protocol: Annotated[str, StringConstraints(pattern=r"^[a-z-]{1,40}$")] | None = Field(
        default=None,
        description="a whole test by its id in `GET /v1/sequences`; None: the default. Not together with segments",
    )
    pulse_rate_hz: RateHz = 40.0
    ran_by: PersonName | None = Field(
        default=None, description="who runs it at the rig, if that is not who asks for it"
    )
    joins: Annotated[str, StringConstraints(max_length=64)] | None = Field(
        default=None, description="a model: the new recording is joined to that model's, and both are judged together"
    )
    target: TargetIn = Field(
        default=TargetIn(), description="kind `adaptive`: what must be known before the test stops"
    )
    max_duration_s: FiniteFloat | None = Field(
        default=None, ge=5, le=300, description="the longest test, s; None: 50 of the kind `adaptive`, 90 of "
        "`passive`, 60 of `moving`"
    )  # fmt: skip
    max_torque_time_nm_s: FiniteFloat | None = Field(
        default=None,
        gt=0,
        le=10_000,
        description="kinds `adaptive` and `moving`: the largest torque-time, N·m·s; None: 12 s at the torque that "
        "stops a test, of `moving` what the default test is expected to take, where a model is approved",
    )
    anyway: StrictBool = Field(
        default=False, description="kind `adaptive`: play it although the target is out of reach"
    )

    angle: AngleIn | None = Field(
        default=None,
        description="kinds `passive`, `held` and `moving`, which have it anyway; kind `sequence`: with it, as {}, the "
        "test stops where the joint leaves the participant's range or the sensor fails",
    )
    reference_torque_nm: Annotated[list[ReferenceNm], Field(min_length=1, max_length=12_000)] | None = Field(
        default=None,
        description="kind `sequence`: the torque that the controller wants, one value for each pulse of the whole "
        "test, N·m. Only to tell the error against it; it changes nothing that is played",
    )

    @field_validator(*LABELS)
    @classmethod
    def _one_line(cls, text: str | None) -> str | None:
        return None if text is None else _plain(text)

    @model_validator(mode="after")
    def _check_kind(self) -> TestIn:
        # Clients that generators make send every default, too.
        sent = set(self.model_dump(exclude_defaults=True, exclude_none=True))
        if self.plan_hash is not None and (more := sent - {"participant", "plan_hash"}):
            raise ValueError(f"plan_hash: all else is as it was previewed; leave out {', '.join(sorted(more))}")
        elsewhere = set().union(*FIELDS_OF.values()) - FIELDS_OF.get(self.kind, CHOSEN_PLAN)
        if wrong := sent & elsewhere:
            raise ValueError(f"{', '.join(sorted(wrong))}: a test of the kind {self.kind} takes none; leave it out")
        if self.angle is not None and self.angle.target_rad is not None and self.kind != HELD:
            raise ValueError("angle.target_rad: only a test of the kind held has a target; leave it out")
        if self.protocol is not None and self.segments is not None:
            raise ValueError("give `protocol` or `segments`, not both")
        return self


class CalibrationIn(Body):
    """Settings of a guided calibration: one current, small steps, short trains."""

    current_ma: CurrentMa | None = Field(None, description="of every pulse, mA; None: the participant's own")
    step_us: Annotated[FiniteFloat, Field(ge=1, le=25, description="how much wider a (fine) step up is, µs")] = 10.0
    large_steps: StrictBool = Field(
        False, description="large steps that become fine near a mark, by the participant's last calibration; the rig "
        "decides how large"
    )  # fmt: skip
    train_s: Annotated[FiniteFloat, Field(ge=0.1, le=2, description="length of a train, s")] = 1.0
    max_pulse_width_us: WidthUs | None = Field(None, description="never wider, µs; None: the rig's limits alone")
    max_torque_nm: TorqueNm | None = Field(
        None, description="torque at which a train stops, and later a test, N·m; None: the participant's own"
    )


class StepIn(Body):
    """One train."""

    direction: Literal["up", "fine", "down", "repeat"] = "up"
    shown_us: Annotated[
        FiniteFloat | None, Field(description="the width that a person was shown; another one is not sent, µs")
    ] = None


class MarkIn(Body):
    """Threshold that the last train's width reached, by the participant's feeling or the muscle's response."""

    threshold: Literal["sensory", "motor", "comfort"]


class NoteIn(Body):
    """A note on a participant's session, on a test, or at a time in a test."""

    kind: NoteKind
    text: Annotated[
        str,
        StringConstraints(max_length=LONGEST_NOTE),
        AfterValidator(_plain),
        Field(description="one line; no names of people"),
    ] = ""
    test_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(None, description="the test it is on")
    at_s: FiniteFloat | None = Field(None, ge=0, description="time in that test, from its start, s")
    now: bool = Field(False, description="at the time where the test stands, which runs")

    @model_validator(mode="after")
    def _whole(self) -> NoteIn:
        if self.test_id is None and (self.at_s is not None or self.now):
            raise ValueError("a time is in a test: send test_id, too")
        if self.now and self.at_s is not None:
            raise ValueError("send at_s or now, not both")
        if self.kind == "other" and not self.text:
            raise ValueError("say in a few words what it is: text")
        return self


class MuscleIn(Body):
    """The site: which side and muscle is stimulated, and where the electrodes are; null where nobody has said."""

    side: Side | None = None
    muscle: Muscle | None = None
    placement: Muscle | None = Field(None, description="of the electrodes; a model belongs to one site", examples=["A"])


class StopIn(Body):
    """A stop, with its reason."""

    reason: Annotated[str, StringConstraints(max_length=200)] = "stop pressed"


class ParticipantIn(MuscleIn):
    """A new participant, and its site."""

    code: Code
    profile: ProfileIn = FIRST_PROFILE


class DecisionIn(Body):
    """Why a model is approved or rejected."""

    reason: Annotated[str, StringConstraints(max_length=500)] = ""


class ApprovalIn(DecisionIn):
    """Why a model is approved, and how far it may be tracked from trial to trial."""

    tracking: Limits = Field(default=Limits())


EffectName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,64}$")]


class EffectsIn(Body):
    """Effects to add to a model."""

    effects: Annotated[list[EffectName], Field(min_length=1)]
    reason: Annotated[str, StringConstraints(max_length=500)] = ""
    force: bool = Field(False, description="add it although the evidence is against it")


class TokenIn(Body):
    """A token to be issued."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_. -]{1,80}$")]
    scopes: Annotated[list[Annotated[Scope, Field(strict=False)]], Field(min_length=1)]
    days: int | None = Field(None, ge=1, le=366, description="it expires after these")


def limits_of(body: TestIn, participant_profile: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the limits of a test, as fields of a `TestPlan`.

    The participant's profile stays whole (thresholds, day, rest), so that the rig judges the calibration that a person
    made; what the request narrows is added to it. Of the request's `profile` only the fields that were sent count.

    Raises ApiError: 422: the participant has no limits; a limit is wider than the participant's, which and by how much.
    """
    limits, requested = participant_profile or {}, body.profile.sent() if body.profile else {}
    if lacking := [name for name in LIMITS if limits.get(name) is None]:
        fix = "Set all of them: PUT /v1/participants/{code}/profile."
        detail = f"{body.participant} has no {', '.join(lacking)}. {fix}"
        raise ApiError(422, "no-limits", "The participant has no limits", detail)
    wider = profiles.above(requested, limits, "the participant's")
    range_rad, own_rad = profiles.range_of(requested), profiles.range_of(limits)
    if range_rad is not None and own_rad is None:
        wider[RANGE] = f"{profiles.range_words(range_rad)} narrows nothing: {body.participant} has no range"
    elif range_rad is not None and not profiles.range_within(range_rad, own_rad):
        own_words = profiles.range_words(own_rad or ())
        wider[RANGE] = f"{profiles.range_words(range_rad)} is beyond the participant's {own_words}"
    if wider:
        errors = [{"field": f"profile.{name}", "detail": f"{name} {words}"} for name, words in wider.items()]
        narrow = "A test may narrow them; to widen them, calibrate anew or set the participant's."
        detail = f"{'; '.join(error['detail'] for error in errors)}. {narrow}"
        raise ApiError(422, "wider-profile", "Wider than the participant's limits", detail, errors=errors)
    overrides = {name: requested[name] for name in ("current_ma", RANGE) if requested.get(name) is not None}
    narrowed = {name: requested.get(name) for name in ("max_pulse_width_us", "max_torque_nm")}
    return {"profile": Profile(**{**limits, **overrides}), **narrowed}
