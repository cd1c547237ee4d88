"""What the centre answers, for its OpenAPI document."""

from __future__ import annotations

from pydantic import Field, JsonValue

from stimrig.api.web.responses.base import Document


class RigOut(Document):
    """A rig, as it was when it was seen last."""

    name: str
    seen_utc: str | None
    revoked_utc: str | None
    version: str | None
    state: str | None
    reason: str | None
    disk_free_bytes: int | None
    disk_total_bytes: int | None
    clock_difference_s: float | None = Field(description="the rig's clock less the centre's")
    waiting_items: int | None
    waiting_files: int | None
    recordings: int


class RigKeyOut(Document):
    """A rig's key; it is shown this once."""

    name: str
    key: str


class WarningOut(Document):
    """What a person has to know of."""

    id: int
    rig: str | None
    kind: str
    subject: str
    detail: dict[str, JsonValue]
    at_utc: str
    again_utc: str
    times: int
    ended_utc: str | None
    acknowledged_by: str | None
    acknowledged_utc: str | None


class ParticipantOut(Document):
    """A participant over all rigs."""

    code: str
    rigs: list[str]
    sessions: int
    recordings: int
    last_utc: str | None
    verdict: str | None


class ParticipantsOut(Document):
    """A page of participants."""

    participants: list[ParticipantOut]
    after: str | None = Field(description="ask with it for the next page; null: this was the last")


class SessionOut(Document):
    """A day of a participant at a rig."""

    day: str
    rig: str
    tests: int
    recordings: int
    model_id: str | None
    verdict: str | None
    approved_by: str | None


class SessionsOut(Document):
    """A page of sessions, newest first."""

    participant: str
    sessions: list[SessionOut]
    before: str | None = Field(description="ask with it for the next page; null: this was the last")


class RecordingOut(Document):
    """A recording."""

    id: int
    rig: str
    recording_id: str = Field(description="its id at the rig")
    participant: str
    test_id: str | None
    origin: str | None
    created_utc: str
    file: str | None = Field(description="SHA-256 of its file; null: the rig has not found it")
    file_bytes: int | None
    url: str


class RecordingsOut(Document):
    """A page of recordings, oldest first."""

    recordings: list[RecordingOut]
    after: str | None = Field(description="ask with it for the next page; null: this was the last")


class CentreHealthOut(Document):
    """How the centre is."""

    status: str
    database: str
    files: str = Field(description="ok, or why the bucket cannot be used")
    uptime_s: float
