"""The tables. Times are UTC, as ISO 8601 labels; documents are JSON. Lengths are checked where a text comes in.

`version` of a row: `stimrig.api.store.locking`.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Boolean, Float, ForeignKey, Integer, LargeBinary, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

OPEN_STATES = ("requested", "running", "sealing", "identifying")
"""States of a test that goes on; in any other it is closed."""


class Table(DeclarativeBase):
    """Base of all tables."""

    def as_dict(self) -> dict[str, Any]:
        """The row as a plain object."""
        return {column.name: getattr(self, column.name) for column in self.__table__.columns}


class Participant(Table):
    __tablename__ = "participants"
    code: Mapped[str] = mapped_column(String, primary_key=True)
    profile: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    created_utc: Mapped[str] = mapped_column(String)
    created_by: Mapped[str] = mapped_column(String)
    side: Mapped[str | None] = mapped_column(String, default=None)
    muscle: Mapped[str | None] = mapped_column(String, default=None)
    placement: Mapped[str | None] = mapped_column(String, default=None)
    """Where the electrodes are: with side and muscle the site, to which models and keys belong."""
    archived_utc: Mapped[str | None] = mapped_column(String, default=None)
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    __mapper_args__ = {"version_id_col": version, "version_id_generator": False}  # noqa: RUF012


class Test(Table):
    """One test; the row is written before the command goes to the rig."""

    __tablename__ = "tests"
    __test__ = False
    id: Mapped[str] = mapped_column(String, primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    kind: Mapped[str] = mapped_column(String)
    state: Mapped[str] = mapped_column(String, index=True)
    reason: Mapped[str] = mapped_column(Text, default="")
    plan: Mapped[dict[str, Any]] = mapped_column(JSON)
    summary: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    recording_id: Mapped[str | None] = mapped_column(String, default=None)
    model_id: Mapped[str | None] = mapped_column(String, default=None)
    requested_by: Mapped[str] = mapped_column(String)
    requested_utc: Mapped[str] = mapped_column(String, index=True)
    finished_utc: Mapped[str | None] = mapped_column(String, default=None)
    ran_by: Mapped[str | None] = mapped_column(String, default=None)
    """Who ran it at the rig, if that was somebody else than `requested_by`."""
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    __mapper_args__ = {"version_id_col": version, "version_id_generator": False}  # noqa: RUF012


class Note(Table):
    """What a person noted about a session, or at a time in a test; struck, but never deleted."""

    __tablename__ = "notes"
    id: Mapped[str] = mapped_column(String, primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    test_id: Mapped[str | None] = mapped_column(ForeignKey("tests.id"), default=None, index=True)
    at_s: Mapped[float | None] = mapped_column(Float, default=None)
    """From the start of the test's signals."""
    kind: Mapped[str] = mapped_column(String)
    text: Mapped[str] = mapped_column(Text, default="")
    by: Mapped[str] = mapped_column(String)
    at_utc: Mapped[str] = mapped_column(String)
    struck_by: Mapped[str | None] = mapped_column(String, default=None)
    struck_utc: Mapped[str | None] = mapped_column(String, default=None)


class Recording(Table):
    __tablename__ = "recordings"
    id: Mapped[str] = mapped_column(String, primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    test_id: Mapped[str | None] = mapped_column(String, default=None, index=True)
    path: Mapped[str] = mapped_column(Text)
    file_sha256: Mapped[str] = mapped_column(String)
    origin: Mapped[str] = mapped_column(String, default="rig")
    created_utc: Mapped[str] = mapped_column(String)
    warnings: Mapped[list[str] | None] = mapped_column(JSON, default=None)
    """What is in doubt about an upload; a test's doubts stand in its summary."""
    site: Mapped[list[str | None] | None] = mapped_column(JSON(none_as_null=True), default=None)
    """Side, muscle and placement that were stimulated; None: from before they were kept."""


class Model(Table):
    """One immutable version; adding an effect makes a child."""

    __tablename__ = "models"
    id: Mapped[str] = mapped_column(String, primary_key=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    recording_id: Mapped[str] = mapped_column(ForeignKey("recordings.id"), index=True)
    parent_id: Mapped[str | None] = mapped_column(String, default=None)
    added_effect: Mapped[str | None] = mapped_column(String, default=None)
    carried_from_id: Mapped[str | None] = mapped_column(String, default=None)
    """The model of an earlier session whose structure this one was fitted with."""
    carried: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True), default=None)
    """What the new record said of that structure."""
    method: Mapped[str] = mapped_column(String)
    effects: Mapped[list[str]] = mapped_column(JSON, default=list)
    fit: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    document: Mapped[bytes] = mapped_column(LargeBinary)
    etag: Mapped[str] = mapped_column(String)
    created_utc: Mapped[str] = mapped_column(String, index=True)
    created_by: Mapped[str] = mapped_column(String)


class Approval(Table):
    """A person's decision on a model; the newest approval of a participant is what the controller gets."""

    __tablename__ = "approvals"
    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"), index=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"), index=True)
    approved: Mapped[bool] = mapped_column(Boolean)
    undone: Mapped[bool | None] = mapped_column(Boolean, default=False)
    """Whether a rejection was an undo; no typed reason says so."""
    reason: Mapped[str] = mapped_column(Text, default="")
    by: Mapped[str] = mapped_column(String)
    at_utc: Mapped[str] = mapped_column(String)
    expires_utc: Mapped[str | None] = mapped_column(String, default=None)
    site: Mapped[list[Any] | None] = mapped_column(JSON(none_as_null=True), default=None)
    """The participant's site then: at another one it does not hold."""
    tracking: Mapped[dict[str, float] | None] = mapped_column(JSON(none_as_null=True), default=None)
    """How far the model may be tracked, in percent (`api.models.tracking.Limits`); None: nobody has allowed it."""


class Tracked(Table):
    """One trial of a controller under an approval: what it said of the muscle, and what was served after it."""

    __tablename__ = "tracked"
    test_id: Mapped[str] = mapped_column(ForeignKey("tests.id"), primary_key=True)
    approval_id: Mapped[int] = mapped_column(ForeignKey("approvals.id"), index=True)
    participant: Mapped[str] = mapped_column(ForeignKey("participants.code"))
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"))
    recording_id: Mapped[str | None] = mapped_column(String, default=None)
    number: Mapped[int] = mapped_column(Integer)
    """Of the approval's trials, from 1."""
    outcome: Mapped[str] = mapped_column(String)
    """As `stimrig.identify.tracking.Outcome`, or `not-followed`."""
    reason: Mapped[str] = mapped_column(Text, default="")
    """Why it was not followed."""
    step: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True), default=None)
    error_percent: Mapped[float | None] = mapped_column(Float, default=None)
    """Error of the torque against the controller's reference, % of the reference's rms."""
    ask: Mapped[str | None] = mapped_column(Text, default=None)
    """Why a new test is needed."""
    document: Mapped[bytes | None] = mapped_column(LargeBinary, default=None)
    """The MODEL.json that was served after it; None: that of the trial before."""
    etag: Mapped[str | None] = mapped_column(String, default=None)
    at_utc: Mapped[str] = mapped_column(String)
    delay_s: Mapped[float | None] = mapped_column(Float, default=None)
    """From its last sample to its being served."""


class Analysis(Table):
    """What a worker found about a model: comparison, diagnosis. Kept, since a model never changes."""

    __tablename__ = "analyses"
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"), primary_key=True)
    kind: Mapped[str] = mapped_column(String, primary_key=True)
    document: Mapped[dict[str, Any]] = mapped_column(JSON)
    created_utc: Mapped[str] = mapped_column(String)


class Token(Table):
    """A bearer token: only its hash is kept."""

    __tablename__ = "tokens"
    hash: Mapped[str] = mapped_column(String, primary_key=True)
    prefix: Mapped[str] = mapped_column(String)
    name: Mapped[str] = mapped_column(String, index=True)
    scopes: Mapped[list[str]] = mapped_column(JSON)
    created_utc: Mapped[str] = mapped_column(String)
    expires_utc: Mapped[str | None] = mapped_column(String, default=None)
    revoked: Mapped[bool] = mapped_column(Boolean, default=False)
    origin: Mapped[str] = mapped_column(String, default="issued")
    participant: Mapped[str | None] = mapped_column(String, default=None)
    """The only one that a controller's key opens; None: a token that is bound to nobody."""
    plan: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True), default=None)
    """What trials a controller's key may play."""
    made_by: Mapped[str | None] = mapped_column(String, default=None)
    """Hash of the token of whoever made a controller's key; it falls with that one."""


class PageSession(Table):
    """A browser's session, opened by signing in with a token."""

    __tablename__ = "page_sessions"
    hash: Mapped[str] = mapped_column(String, primary_key=True)
    token_hash: Mapped[str] = mapped_column(ForeignKey("tokens.hash"))
    csrf: Mapped[str] = mapped_column(String)
    created_unix_s: Mapped[float] = mapped_column(Float)
    expires_unix_s: Mapped[float] = mapped_column(Float)
    acted_unix_s: Mapped[float | None] = mapped_column(Float, default=None)
    """When a person last did something in it; None: not since it was opened."""
    locked_unix_s: Mapped[float | None] = mapped_column(Float, default=None)


class User(Table):
    """A person with a password; what it may do, and whether still, is said by a token that nobody holds the text of."""

    __tablename__ = "users"
    name: Mapped[str] = mapped_column(String, primary_key=True)
    folded_name: Mapped[str | None] = mapped_column(String, default=None, index=True)
    """The name as two people must not share it: without its case."""
    password_hash: Mapped[str] = mapped_column(String)
    token_hash: Mapped[str] = mapped_column(ForeignKey("tokens.hash"))
    created_utc: Mapped[str] = mapped_column(String)
    changed_utc: Mapped[str] = mapped_column(String)
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    __mapper_args__ = {"version_id_col": version, "version_id_generator": False}  # noqa: RUF012


class KnownPlace(Table):
    """Where a person has signed in from: guesses from elsewhere do not hold them back there."""

    __tablename__ = "known_places"
    name: Mapped[str] = mapped_column(ForeignKey("users.name"), primary_key=True)
    place: Mapped[str] = mapped_column(String, primary_key=True)
    at_unix_s: Mapped[float] = mapped_column(Float)


class Confirmation(Table):
    """A signed-in person has given the password once more; good for one approval."""

    __tablename__ = "confirmations"
    session_hash: Mapped[str] = mapped_column(String, primary_key=True)
    at_unix_s: Mapped[float] = mapped_column(Float)


class Secret(Table):
    """A secret of the service that outlives a restart (`Store.secret`)."""

    __tablename__ = "secrets"
    name: Mapped[str] = mapped_column(String, primary_key=True)
    value: Mapped[bytes] = mapped_column(LargeBinary)


class AuditEntry(Table):
    """Who did what, when, to what; each entry holds the hash of the one before."""

    __tablename__ = "audit"
    seq: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    at_utc: Mapped[str] = mapped_column(String)
    who: Mapped[str] = mapped_column(String)
    action: Mapped[str] = mapped_column(String)
    subject: Mapped[str] = mapped_column(String, index=True)
    detail: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    previous_hash: Mapped[str] = mapped_column(String)
    hash: Mapped[str] = mapped_column(String)
