"""What clients send to the other routes, each field checked; docs/api.md says what they get."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, FiniteFloat, StringConstraints

from stimrig.api.clock import unix_of, utc_label
from stimrig.api.models.tracking import USUAL_PERCENT, Limits
from stimrig.api.sessions.requests import FIRST_PROFILE, Body, Code, FirstProfileIn, MuscleIn, PersonName


class ParticipantIn(MuscleIn):
    """A new participant, and its site."""

    code: Code
    profile: FirstProfileIn = Field(default=FIRST_PROFILE)


class RanByIn(Body):
    """Who ran a test at the rig."""

    ran_by: PersonName | None = Field(None, description="null: who asked for it")


class DecisionIn(Body):
    """Why a model is approved or rejected."""

    reason: Annotated[str, StringConstraints(max_length=500)] = ""


class TrackingIn(Body):
    """How far a tracked model may move from the approved one, either way, 0 to 60 %; 0: this stays as approved."""

    gain_percent: FiniteFloat = Field(default=USUAL_PERCENT, description="of the gain")
    threshold_percent: FiniteFloat = Field(
        default=USUAL_PERCENT, description="of the threshold: the width at which the curve has gone 5 % of its way"
    )
    time_scale_percent: FiniteFloat = Field(default=USUAL_PERCENT, description="of the time scale")

    def limits(self) -> Limits:
        """As the registry takes them."""
        return Limits(**self.model_dump())


class ApprovalIn(DecisionIn):
    """Why a model is approved, and how far it may be tracked from trial to trial."""

    tracking: TrackingIn = Field(default=TrackingIn())


class EffectsIn(Body):
    """Effects to add to a model."""

    effects: Annotated[list[Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,64}$")]], Field(min_length=1)]
    reason: Annotated[str, StringConstraints(max_length=500)] = ""
    force: bool = Field(False, description="add it although the evidence is against it")


class TokenIn(Body):
    """A token to be issued."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_. -]{1,80}$")]
    scopes: Annotated[list[str], Field(min_length=1)]
    expires_utc: (
        Annotated[
            str,
            StringConstraints(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]+)?Z$"),
            AfterValidator(lambda label: utc_label(unix_of(label))),  # as our clock writes them: they are compared
        ]
        | None
    ) = None
