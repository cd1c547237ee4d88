"""The tables. Times are UTC, as ISO 8601 labels; documents are JSON. Lengths are checked where a text comes in.

`version` of a row: `stimrig.api.store.locking`.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

OPEN_STATES = ("requested", "running", "sealing", "identifying")
"""States of a test that goes on; in any other it is closed."""


JSON_TYPES = (dict[str, Any], dict[str, float], list[Any], list[str], list[str | None])


class Table(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map = dict.fromkeys(JSON_TYPES, JSON(none_as_null=True))

    def as_dict(self) -> dict[str, Any]:
        """The row as a plain object."""
        return {column.name: getattr(self, column.name) for column in self.__table__.columns}


class Participant(Table):
    __tablename__ = "participants"
    code: Mapped[str] = mapped_column(primary_key=True)
    profile: Mapped[dict[str, Any]] = mapped_column(default=dict)
    created_utc: Mapped[str]
    created_by: Mapped[str]
    side: Mapped[str | None]
    muscle: Mapped[str | None]
    placement: Mapped[str | None]
    """Where the electrodes are: with side and muscle the site, to which models and keys belong."""
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    __mapper_args__ = {"version_id_col": version, "version_id_generator": False}  # noqa: RUF012


class Test(Table):
    """One test; the row is written before the command goes to the rig."""

    __tablename__ = "tests"
    __test__ = False
    id: Mapped[str] = mapped_column(primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    kind: Mapped[str]
    state: Mapped[str] = mapped_column(index=True)
    reason: Mapped[str] = mapped_column(default="")
    plan: Mapped[dict[str, Any]]
    summary: Mapped[dict[str, Any]] = mapped_column(default=dict)
    recording_id: Mapped[str | None]
    model_id: Mapped[str | None]
    requested_by: Mapped[str]
    requested_utc: Mapped[str] = mapped_column(index=True)
    finished_utc: Mapped[str | None]
    ran_by: Mapped[str | None]
    """The person who ran it at the rig, if not `requested_by`."""


class Note(Table):
    """A person's note on a session, or on a time in a test; struck, but never deleted."""

    __tablename__ = "notes"
    id: Mapped[str] = mapped_column(primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    test_id: Mapped[str | None] = mapped_column(ForeignKey("tests.id"), default=None, index=True)
    at_s: Mapped[float | None]
    """From the start of the test's signals."""
    kind: Mapped[str]
    text: Mapped[str] = mapped_column(default="")
    by: Mapped[str]
    at_utc: Mapped[str]
    struck_by: Mapped[str | None]
    struck_utc: Mapped[str | None]


class Recording(Table):
    __tablename__ = "recordings"
    id: Mapped[str] = mapped_column(primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    test_id: Mapped[str | None] = mapped_column(index=True)
    path: Mapped[str]
    file_sha256: Mapped[str]
    samples_sha256: Mapped[str | None]
    """Hash of the measured samples, same in each format (`record_files.samples_sha256`); empty: they cannot be read."""
    origin: Mapped[str] = mapped_column(default="rig")
    created_utc: Mapped[str]
    warnings: Mapped[list[str] | None]
    """Doubts about an upload; those about a test are in its summary."""
    site: Mapped[list[Any] | None]
    """Side, muscle and placement that were stimulated, and the current of an upload or a joined recording, mA.

    None: from before they were kept.
    """


class Model(Table):
    """One immutable version; adding an effect makes a child."""

    __tablename__ = "models"
    id: Mapped[str] = mapped_column(primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    recording_id: Mapped[str] = mapped_column(ForeignKey("recordings.id"), index=True)
    parent_id: Mapped[str | None]
    added_effect: Mapped[str | None]
    carried_from_id: Mapped[str | None]
    """The model of an earlier session whose structure this one was fitted with."""
    carried: Mapped[dict[str, Any] | None]
    """Assessment of that structure on the new record."""
    method: Mapped[str]
    effects: Mapped[list[str]] = mapped_column(default=list)
    fit: Mapped[dict[str, Any]] = mapped_column(default=dict)
    document: Mapped[bytes]
    etag: Mapped[str]
    created_utc: Mapped[str] = mapped_column(index=True)
    created_by: Mapped[str]


class Approval(Table):
    """A person's decision on a model; the newest approval of a participant is what the controller gets."""

    __tablename__ = "approvals"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"), index=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    approved: Mapped[bool]
    reason: Mapped[str] = mapped_column(default="")
    by: Mapped[str]
    at_utc: Mapped[str]
    expires_utc: Mapped[str | None]
    site: Mapped[list[Any] | None]
    """The participant's site then: at another one it does not hold."""
    tracking: Mapped[dict[str, float] | None]
    """Limits of tracking the model, in percent (`api.models.tracking.Limits`); None: tracking is not allowed."""


class Tracked(Table):
    """One trial of a controller under an approval: what it said of the muscle, and what was served after it."""

    __tablename__ = "tracked"
    test_id: Mapped[str] = mapped_column(ForeignKey("tests.id"), primary_key=True)
    approval_id: Mapped[int] = mapped_column(ForeignKey("approvals.id"), index=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"))
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"))
    recording_id: Mapped[str | None]
    number: Mapped[int]
    """Number among the approval's trials, from 1."""
    outcome: Mapped[str]
    """As `stimrig.identify.tracking.Outcome`, or `not-followed`."""
    reason: Mapped[str] = mapped_column(default="")
    """Why it was not followed."""
    step: Mapped[dict[str, Any] | None]
    error_percent: Mapped[float | None]
    """Error of the torque against the controller's reference, % of the reference's rms."""
    ask: Mapped[str | None]
    """Why a new test is needed."""
    document: Mapped[bytes | None]
    """The MODEL.json that was served after it; None: that of the trial before."""
    etag: Mapped[str | None]
    at_utc: Mapped[str]
    delay_s: Mapped[float | None]
    """From its last sample to its being served."""


class Analysis(Table):
    """A worker's result about a model: comparison, diagnosis. It is stored, since a model never changes."""

    __tablename__ = "analyses"
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"), primary_key=True)
    kind: Mapped[str] = mapped_column(primary_key=True)
    document: Mapped[dict[str, Any]]
    created_utc: Mapped[str]


class Token(Table):
    """A bearer token: only its hash is kept."""

    __tablename__ = "tokens"
    hash: Mapped[str] = mapped_column(primary_key=True)
    prefix: Mapped[str]
    name: Mapped[str] = mapped_column(index=True)
    scopes: Mapped[list[str]]
    created_utc: Mapped[str]
    expires_utc: Mapped[str | None]
    revoked: Mapped[bool] = mapped_column(default=False)
    origin: Mapped[str] = mapped_column(default="issued")
    participant: Mapped[str | None]
    """The only one that a controller's key opens; None: a token that is bound to nobody."""
    plan: Mapped[dict[str, Any] | None]
    """Plan of the trials that a controller's key may play."""
    made_by: Mapped[str | None]
    """Hash of the token of whoever made a controller's key; it falls with that one."""


class PageSession(Table):
    """A browser's session, opened by signing in with a token."""

    __tablename__ = "page_sessions"
    hash: Mapped[str] = mapped_column(primary_key=True)
    token_hash: Mapped[str] = mapped_column(ForeignKey("tokens.hash"))
    csrf: Mapped[str]
    created_unix_s: Mapped[float]
    expires_unix_s: Mapped[float]
    acted_unix_s: Mapped[float | None]
    """When a person last did something in it; None: not since it was opened."""
    confirmed_unix_s: Mapped[float | None]
    """When its person gave the password once more; good for one decision on a model."""


class User(Table):
    """A person with a password; what it may do, and whether still, is said by a token that nobody holds the text of."""

    __tablename__ = "users"
    name: Mapped[str] = mapped_column(primary_key=True)
    folded_name: Mapped[str] = mapped_column(unique=True)
    """The name as two people must not share it: without its case."""
    password_hash: Mapped[str]
    token_hash: Mapped[str] = mapped_column(ForeignKey("tokens.hash"))
    places: Mapped[list[str]] = mapped_column(default=list)
    """Where the person has signed in from, the last one first: guesses from elsewhere do not hold them back there."""
    created_utc: Mapped[str]
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    __mapper_args__ = {"version_id_col": version, "version_id_generator": False}  # noqa: RUF012


class Secret(Table):
    """A secret of the service that outlives a restart (`Store.secret`)."""

    __tablename__ = "secrets"
    name: Mapped[str] = mapped_column(primary_key=True)
    value: Mapped[bytes]


class AuditEntry(Table):
    """One action with its actor, time and subject; each entry has the hash of the one before."""

    __tablename__ = "audit"
    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    at_utc: Mapped[str]
    who: Mapped[str]
    action: Mapped[str]
    subject: Mapped[str] = mapped_column(index=True)
    detail: Mapped[dict[str, Any]] = mapped_column(default=dict)
    previous_hash: Mapped[str]
    hash: Mapped[str]
