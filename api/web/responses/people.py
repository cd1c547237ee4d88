"""Answers about participants and their calibration, people, tokens and the audit trail."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from stimrig.api.schemas.shared import NoteKind, Scope
from stimrig.api.web.responses.base import Document, EntryOut
from stimrig.rig.messages import CalibrationStatus, Profile, RigState


class UserOut(Document):
    """A person who may sign in on the page."""

    name: str
    scopes: list[Scope]
    created_utc: str


class ListedUser(UserOut):
    """A person in the list of all."""

    removed: bool = Field(description="signs in no more")
    version: int = Field(description="of the account: `If-Match` of a new password")


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
    id: str = Field(description="for `DELETE /v1/participants/{code}/keys/{id}`")
    name: str = Field(description="under which its trials are kept")
    participant: str = Field(description="the only one that it opens")
    plan: dict[str, JsonValue] = Field(description="what trials it may play")


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


class ProfileOut(Profile, Document):
    """A participant's limits for the day."""


class ParticipantOut(Document):
    """A participant: a code, never a name."""

    code: str
    profile: ProfileOut
    created_utc: str
    created_by: str
    side: Literal["left", "right"] | None = Field(description="of the body; null: nobody has said")
    muscle: str | None = Field(description="the muscle that is stimulated")
    placement: str | None = Field(description="of the electrodes: with side and muscle the site")
    version: int = Field(description="of all that is decided about the participant: its `ETag`")


class NoteOut(Document):
    """A note on a session, or at a time in a test."""

    id: str
    participant: str
    test_id: str | None = Field(description="null: on the participant's session, not on a test")
    at_s: float | None = Field(description="time in the test, from its start, s; null: on the whole of it")
    kind: NoteKind
    text: str
    by: str
    at_utc: str
    struck_by: str | None = Field(description="who marked it as wrong; null: it stands")
    struck_utc: str | None


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
