"""The tables of a centre: what rigs have pushed, and narrow ones for what its pages ask.

Texts that rigs send are cut and cleaned where they come in (`api.centre.project`). Columns that are sorted or searched
compare bytes, so that a prefix is found by an index whatever the database's locale.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Boolean, Float, ForeignKey, Index, Integer, String, Text
from sqlalchemy.orm import Mapped, mapped_column

from stimrig.api.store.tables import Table

Word = String().with_variant(String(collation="C"), "postgresql")
Number = BigInteger().with_variant(Integer, "sqlite")


class CentreRig(Table):
    """A rig, its key, and what it said of itself last."""

    __tablename__ = "centre_rigs"
    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    name: Mapped[str] = mapped_column(Word, unique=True)
    key_hash: Mapped[str] = mapped_column(Word, unique=True)
    key_prefix: Mapped[str] = mapped_column(String)
    created_utc: Mapped[str] = mapped_column(String)
    created_by: Mapped[str] = mapped_column(String)
    revoked_utc: Mapped[str | None] = mapped_column(String, default=None)
    seen_utc: Mapped[str | None] = mapped_column(String, default=None)
    version: Mapped[str | None] = mapped_column(String, default=None)
    state: Mapped[str | None] = mapped_column(String, default=None)
    reason: Mapped[str | None] = mapped_column(Text, default=None)
    disk_free_bytes: Mapped[int | None] = mapped_column(Number, default=None)
    disk_total_bytes: Mapped[int | None] = mapped_column(Number, default=None)
    clock_difference_s: Mapped[float | None] = mapped_column(Float, default=None)
    """The rig's clock less the centre's."""
    waiting_items: Mapped[int | None] = mapped_column(Number, default=None)
    waiting_files: Mapped[int | None] = mapped_column(Number, default=None)
    chain: Mapped[str | None] = mapped_column(String, default=None)
    audit_seq: Mapped[int | None] = mapped_column(Number, default=None)
    audit_hash: Mapped[str | None] = mapped_column(String, default=None)
    recordings: Mapped[int] = mapped_column(Number, default=0)


class CentreChain(Table):
    """How far a rig's chain has come."""

    __tablename__ = "centre_chains"
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    chain: Mapped[str] = mapped_column(Word, primary_key=True)
    seq: Mapped[int] = mapped_column(Number)
    hash: Mapped[str] = mapped_column(String)
    begun_utc: Mapped[str] = mapped_column(String)


class CentreItem(Table):
    """An item as it came; `body` is its canonical text, None where the same was told before."""

    __tablename__ = "centre_items"
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    chain: Mapped[str] = mapped_column(Word, primary_key=True)
    seq: Mapped[int] = mapped_column(Number, primary_key=True)
    kind: Mapped[str] = mapped_column(Word)
    key: Mapped[str] = mapped_column(Word)
    sha256: Mapped[str] = mapped_column(Word)
    file: Mapped[str | None] = mapped_column(Word, default=None)
    file_bytes: Mapped[int | None] = mapped_column(Number, default=None)
    at_utc: Mapped[str] = mapped_column(String)
    received_utc: Mapped[str] = mapped_column(String)
    previous: Mapped[str] = mapped_column(String)
    hash: Mapped[str] = mapped_column(String)
    body: Mapped[str | None] = mapped_column(Text, default=None)
    __table_args__ = (Index("ix_centre_items_told", "rig_id", "kind", "key"), Index("ix_centre_items_file", "file"))


class CentreFile(Table):
    """A file in the bucket."""

    __tablename__ = "centre_files"
    sha256: Mapped[str] = mapped_column(Word, primary_key=True)
    bytes: Mapped[int] = mapped_column(Number)
    whole_utc: Mapped[str] = mapped_column(String)
    checked_utc: Mapped[str | None] = mapped_column(String, default=None)
    ok: Mapped[bool] = mapped_column(Boolean, default=True)


class CentreWanted(Table):
    """A file that a rig named and the centre lacks; the row goes when the file is whole."""

    __tablename__ = "centre_wanted"
    id: Mapped[int] = mapped_column(Number, primary_key=True, autoincrement=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"))
    sha256: Mapped[str] = mapped_column(Word)
    bytes: Mapped[int] = mapped_column(Number)
    __table_args__ = (
        Index("ix_centre_wanted_rig", "rig_id", "id"),
        Index("ix_centre_wanted_file", "sha256", "rig_id", unique=True),
    )


class CentreWarning(Table):
    """What a person has to know of; one row as long as it holds."""

    __tablename__ = "centre_warnings"
    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    rig_id: Mapped[int | None] = mapped_column(ForeignKey("centre_rigs.id"), default=None)
    kind: Mapped[str] = mapped_column(Word)
    subject: Mapped[str] = mapped_column(Word, default="")
    detail: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    at_utc: Mapped[str] = mapped_column(Word)
    again_utc: Mapped[str] = mapped_column(String)
    times: Mapped[int] = mapped_column(Integer, default=1)
    ended_utc: Mapped[str | None] = mapped_column(Word, default=None)
    acknowledged_by: Mapped[str | None] = mapped_column(String, default=None)
    acknowledged_utc: Mapped[str | None] = mapped_column(Word, default=None)
    __table_args__ = (
        Index("ix_centre_warnings_of", "rig_id", "kind", "subject"),
        Index("ix_centre_warnings_open", "acknowledged_utc", "id"),
    )


class CentreParticipant(Table):
    """A participant at a rig."""

    __tablename__ = "centre_participants"
    code: Mapped[str] = mapped_column(Word, primary_key=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    side: Mapped[str | None] = mapped_column(String, default=None)
    muscle: Mapped[str | None] = mapped_column(String, default=None)
    archived_utc: Mapped[str | None] = mapped_column(String, default=None)
    sessions: Mapped[int] = mapped_column(Integer, default=0)
    recordings: Mapped[int] = mapped_column(Integer, default=0)
    last_utc: Mapped[str | None] = mapped_column(Word, default=None)
    verdict: Mapped[str | None] = mapped_column(String, default=None)
    """Of the newest model."""
    __table_args__ = (Index("ix_centre_participants_rig", "rig_id", "code"),)


class CentreSession(Table):
    """A day of a participant at a rig, with the model that stands for it: the approved one, else the newest."""

    __tablename__ = "centre_sessions"
    participant: Mapped[str] = mapped_column(Word, primary_key=True)
    day: Mapped[str] = mapped_column(Word, primary_key=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    at_utc: Mapped[str] = mapped_column(String)
    tests: Mapped[int] = mapped_column(Integer, default=0)
    recordings: Mapped[int] = mapped_column(Integer, default=0)
    model_id: Mapped[str | None] = mapped_column(String, default=None)
    model_utc: Mapped[str | None] = mapped_column(String, default=None)
    verdict: Mapped[str | None] = mapped_column(Word, default=None)
    approved_by: Mapped[str | None] = mapped_column(String, default=None)
    current_ma: Mapped[float | None] = mapped_column(Float, default=None)
    """Of its last test: of which the figures of the curve depend."""
    __table_args__ = (
        Index("ix_centre_sessions_day", "day", "participant", "rig_id"),
        Index("ix_centre_sessions_rig", "participant", "rig_id", "day"),
        Index("ix_centre_sessions_verdict", "verdict", "participant", "rig_id", "day"),
    )


class CentreTest(Table):
    """A test that is over."""

    __tablename__ = "centre_tests"
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    id: Mapped[str] = mapped_column(Word, primary_key=True)
    participant: Mapped[str] = mapped_column(Word)
    kind: Mapped[str | None] = mapped_column(String, default=None)
    state: Mapped[str | None] = mapped_column(String, default=None)
    reason: Mapped[str | None] = mapped_column(Text, default=None)
    recording_id: Mapped[str | None] = mapped_column(String, default=None)
    model_id: Mapped[str | None] = mapped_column(String, default=None)
    requested_utc: Mapped[str] = mapped_column(Word)
    finished_utc: Mapped[str | None] = mapped_column(String, default=None)
    __table_args__ = (Index("ix_centre_tests_participant", "participant", "requested_utc"),)


class CentreRecording(Table):
    """A recording; `id` is the centre's, `recording_id` the rig's."""

    __tablename__ = "centre_recordings"
    id: Mapped[int] = mapped_column(Number, primary_key=True, autoincrement=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"))
    recording_id: Mapped[str] = mapped_column(Word)
    participant: Mapped[str] = mapped_column(Word)
    test_id: Mapped[str | None] = mapped_column(String, default=None)
    origin: Mapped[str | None] = mapped_column(String, default=None)
    created_utc: Mapped[str] = mapped_column(Word)
    file: Mapped[str | None] = mapped_column(Word, default=None)
    file_bytes: Mapped[int | None] = mapped_column(Number, default=None)
    __table_args__ = (
        Index("ix_centre_recordings_of", "rig_id", "recording_id", unique=True),
        Index("ix_centre_recordings_participant", "participant", "created_utc", "id"),
        Index("ix_centre_recordings_rig", "rig_id", "created_utc", "id"),
        Index("ix_centre_recordings_time", "created_utc", "id"),
    )


class CentreModel(Table):
    """A model version; its MODEL.json is a file. `fit` holds its figures and verdict, as `models.fit` at the rig."""

    __tablename__ = "centre_models"
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    id: Mapped[str] = mapped_column(Word, primary_key=True)
    participant: Mapped[str] = mapped_column(Word)
    recording_id: Mapped[str | None] = mapped_column(String, default=None)
    parent_id: Mapped[str | None] = mapped_column(String, default=None)
    method: Mapped[str | None] = mapped_column(String, default=None)
    effects: Mapped[list[str]] = mapped_column(JSON, default=list)
    verdict: Mapped[str | None] = mapped_column(String, default=None)
    fit: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    created_utc: Mapped[str] = mapped_column(Word)
    file: Mapped[str | None] = mapped_column(Word, default=None)
    file_bytes: Mapped[int | None] = mapped_column(Number, default=None)
    __table_args__ = (Index("ix_centre_models_participant", "participant", "created_utc"),)


class CentreEffect(Table):
    """An effect that a model of a participant holds."""

    __tablename__ = "centre_effects"
    effect: Mapped[str] = mapped_column(Word, primary_key=True)
    participant: Mapped[str] = mapped_column(Word, primary_key=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)


class CentreDecision(Table):
    """What a person decided on a model; known by its content, as a restored rig numbers anew."""

    __tablename__ = "centre_decisions"
    rig_id: Mapped[int] = mapped_column(ForeignKey("centre_rigs.id"), primary_key=True)
    sha256: Mapped[str] = mapped_column(Word, primary_key=True)
    participant: Mapped[str] = mapped_column(Word)
    model_id: Mapped[str] = mapped_column(String)
    approved: Mapped[bool] = mapped_column(Boolean)
    reason: Mapped[str] = mapped_column(Text, default="")
    by: Mapped[str] = mapped_column(String, default="")
    at_utc: Mapped[str] = mapped_column(Word)
    __table_args__ = (Index("ix_centre_decisions_participant", "participant", "at_utc"),)
