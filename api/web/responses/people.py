"""Answers about participants and their calibration, people, tokens and the audit trail."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from stimrig.api.client import documents
from stimrig.api.people.auth import Scope
from stimrig.api.sessions.requests import NoteKind
from stimrig.api.web.responses.base import Document, EntryOut, fields_of
from stimrig.rig.messages import CalibrationStatus, RigState


class UserOut(Document):
    """A person who may sign in on the page."""

    name: str
    scopes: list[Scope]
    created_utc: str


class ListedUser(UserOut):
    """A person in the list of all."""

    removed: bool = Field(description="signs in no more")


class SessionOut(Document):
    """A session; its cookie is in `Set-Cookie`."""

    name: str
    scopes: list[Scope]
    csrf: str = Field(description="send it as `X-CSRF-Token` with everything but GET")


class KeyOut(Document):
    """A controller's key."""

    key: str = Field(description="its text, shown this once; send it as `Authorization: Bearer …`")
    prefix: str
    scopes: list[Scope]
    expires_utc: str
    id: str | None = Field(None, description="of a key that plays trials: for `DELETE /v1/tokens/{id}`")
    name: str | None = Field(None, description="under which its trials are kept")
    participant: str | None = Field(None, description="the only one that it opens")
    plan: dict[str, JsonValue] | None = Field(None, description="what trials it may play")


class TokenOut(Document):
    """A token that was issued."""

    token: str = Field(description="its text, shown this once; send it as `Authorization: Bearer …`")
    name: str
    scopes: list[Scope]
    expires_utc: str | None = Field(description="null: it does not expire")


class ListedToken(Document):
    """A token, without its text."""

    id: str = Field(description="for `DELETE /v1/tokens/{id}`")
    prefix: str
    name: str
    scopes: list[Scope]
    created_utc: str
    expires_utc: str | None
    revoked: bool
    origin: str
    participant: str | None = Field(None, description="the only one that a controller's key opens")
    plan: dict[str, JsonValue] | None = Field(None, description="what trials that key may play")


class AuditEntryOut(EntryOut):
    """An entry of the audit trail."""

    seq: int
    previous_hash: str
    hash: str = Field(description="SHA-256 of the entry's canonical JSON without this field")


class AuditOut(Document):
    """The audit trail."""

    whole: bool = Field(description="whether the chain of hashes holds")
    first_broken: int | None = Field(description="`seq` of the first entry that does not hold")
    entries: list[AuditEntryOut]


class ProfileOut(Document):
    """A participant's limits for the day."""

    current_ma: float = Field(description="fixed current of every pulse, mA")
    max_pulse_width_us: float = Field(description="comfort maximum, µs")
    max_torque_nm: float = Field(description="torque at which a test stops, N·m")
    sensory_pulse_width_us: float | None = Field(None, description="width at which it is first felt, µs")
    motor_pulse_width_us: float | None = Field(None, description="width at which the muscle first moves, µs")
    set_at_utc: str | None = Field(None, description="when the calibration was finished")
    expires_at_utc: str | None = Field(None, description="when the calibration expires: the end of its day")
    rest_between_tests_s: float | None = Field(None, description="shortest rest between two tests, s")
    angle_range_rad: list[float] | None = Field(None, description="joint angles that are comfortable today, rad")
    angle_set_at_utc: str | None = Field(None, description="of the angle sensor: its calibration when that was said")


class ParticipantOut(fields_of(documents.Participant)):
    """A participant: a code, never a name."""

    profile: ProfileOut
    side: Literal["left", "right"] | None = Field(None, description="of the body; null: nobody has said")
    muscle: str | None = Field(None, description="the muscle that is stimulated")
    placement: str | None = Field(None, description="of the electrodes: with side and muscle the site")
    archived_utc: str | None = Field(None, description="since when it is archived: no test starts, nothing is deleted")


class NoteOut(fields_of(documents.Note)):
    """A note on a session, or at a time in a test."""

    kind: NoteKind


class ChangedOut(ParticipantOut):
    """A participant whose limits were changed."""

    meanwhile: str = Field(description="what the change means for a test that runs or a calibration that is open")


class CalibrationOut(CalibrationStatus, Document):
    """Where a guided calibration stands."""

    rig_state: RigState
    playing: bool = Field(description="a train is on its way")
    outdated: str = Field(description="why it goes no further: the limits were changed since; else empty")
    version: str = Field(description="of what is shown: the calibration, and how many trains were sent")


class CalibratedOut(Document):
    """A calibration that was closed."""

    profile: ProfileOut | None = Field(description="null: discarded")
    recordings: list[str] = Field(description="one sealed recording for each train")
