"""The first tables."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0001", None


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "participants",
        sa.Column("code", sa.String(32), primary_key=True),
        sa.Column("profile", sa.JSON, nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False),
        sa.Column("created_by", sa.String(80), nullable=False),
    )
    op.create_table(
        "tests",
        sa.Column("id", sa.String(40), primary_key=True),
        _participant(),
        sa.Column("kind", sa.String(40), nullable=False),
        sa.Column("state", sa.String(20), nullable=False, index=True),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("plan", sa.JSON, nullable=False),
        sa.Column("summary", sa.JSON, nullable=False),
        sa.Column("recording_id", sa.String(64)),
        sa.Column("model_id", sa.String(64)),
        sa.Column("requested_by", sa.String(80), nullable=False),
        sa.Column("requested_utc", sa.String(32), nullable=False, index=True),
        sa.Column("finished_utc", sa.String(32)),
    )
    op.create_table(
        "recordings",
        sa.Column("id", sa.String(64), primary_key=True),
        _participant(),
        sa.Column("test_id", sa.String(40), index=True),
        sa.Column("path", sa.Text, nullable=False),
        sa.Column("file_sha256", sa.String(64), nullable=False),
        sa.Column("origin", sa.String(20), nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False),
    )
    _models()
    _people()
    op.create_table(
        "audit",
        sa.Column("seq", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("at_utc", sa.String(32), nullable=False),
        sa.Column("who", sa.String(80), nullable=False),
        sa.Column("action", sa.String(60), nullable=False),
        sa.Column("subject", sa.String(120), nullable=False),
        sa.Column("detail", sa.JSON, nullable=False),
        sa.Column("previous_hash", sa.String(64), nullable=False),
        sa.Column("hash", sa.String(64), nullable=False),
    )


def _models() -> None:
    op.create_table(
        "models",
        sa.Column("id", sa.String(64), primary_key=True),
        _participant(),
        sa.Column("recording_id", sa.String(64), sa.ForeignKey("recordings.id"), nullable=False, index=True),
        sa.Column("parent_id", sa.String(64)),
        sa.Column("added_effect", sa.String(64)),
        sa.Column("method", sa.String(40), nullable=False),
        sa.Column("effects", sa.JSON, nullable=False),
        sa.Column("fit", sa.JSON, nullable=False),
        sa.Column("document", sa.LargeBinary, nullable=False),
        sa.Column("etag", sa.String(64), nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False, index=True),
        sa.Column("created_by", sa.String(80), nullable=False),
    )
    op.create_table(
        "approvals",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("model_id", sa.String(64), sa.ForeignKey("models.id"), nullable=False, index=True),
        _participant(),
        sa.Column("approved", sa.Boolean, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("by", sa.String(80), nullable=False),
        sa.Column("at_utc", sa.String(32), nullable=False),
    )
    op.create_table(
        "analyses",
        sa.Column("model_id", sa.String(64), sa.ForeignKey("models.id"), primary_key=True),
        sa.Column("kind", sa.String(40), primary_key=True),
        sa.Column("document", sa.JSON, nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False),
    )


def _people() -> None:
    op.create_table(
        "tokens",
        sa.Column("hash", sa.String(64), primary_key=True),
        sa.Column("prefix", sa.String(16), nullable=False),
        sa.Column("name", sa.String(80), nullable=False, index=True),
        sa.Column("scopes", sa.JSON, nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False),
        sa.Column("expires_utc", sa.String(32)),
        sa.Column("revoked", sa.Boolean, nullable=False),
        sa.Column("origin", sa.String(20), nullable=False),
    )
    op.create_table(
        "page_sessions",
        sa.Column("hash", sa.String(64), primary_key=True),
        sa.Column("token_hash", sa.String(64), sa.ForeignKey("tokens.hash"), nullable=False),
        sa.Column("csrf", sa.String(64), nullable=False),
        sa.Column("created_unix_s", sa.Float, nullable=False),
        sa.Column("expires_unix_s", sa.Float, nullable=False),
    )


def _participant() -> sa.Column[str]:
    return sa.Column("participant", sa.String(32), sa.ForeignKey("participants.code"), nullable=False, index=True)
