"""What a centre keeps of its rigs."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0012", "0011"

WORD = sa.String().with_variant(sa.String(collation="C"), "postgresql")
NUMBER = sa.BigInteger().with_variant(sa.Integer, "sqlite")
RIG = "centre_rigs.id"


def upgrade() -> None:
    """Make the tables; they stay empty at a rig."""
    _rigs()
    _chains()
    _items()
    _files()
    _wanted()
    _warnings()
    _participants()
    _sessions()
    _tests()
    _recordings()
    _models()
    _effects()
    _decisions()


def _rigs() -> None:
    op.create_table(
        "centre_rigs",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("name", WORD, nullable=False, unique=True),
        sa.Column("key_hash", WORD, nullable=False, unique=True),
        sa.Column("key_prefix", sa.String, nullable=False),
        sa.Column("created_utc", sa.String, nullable=False),
        sa.Column("created_by", sa.String, nullable=False),
        sa.Column("revoked_utc", sa.String),
        sa.Column("seen_utc", sa.String),
        sa.Column("version", sa.String),
        sa.Column("state", sa.String),
        sa.Column("reason", sa.Text),
        sa.Column("disk_free_bytes", NUMBER),
        sa.Column("disk_total_bytes", NUMBER),
        sa.Column("clock_difference_s", sa.Float),
        sa.Column("waiting_items", NUMBER),
        sa.Column("waiting_files", NUMBER),
        sa.Column("chain", sa.String),
        sa.Column("audit_seq", NUMBER),
        sa.Column("audit_hash", sa.String),
        sa.Column("recordings", NUMBER, nullable=False),
    )


def _chains() -> None:
    op.create_table(
        "centre_chains",
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("chain", WORD, primary_key=True),
        sa.Column("seq", NUMBER, nullable=False),
        sa.Column("hash", sa.String, nullable=False),
        sa.Column("begun_utc", sa.String, nullable=False),
    )


def _items() -> None:
    op.create_table(
        "centre_items",
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("chain", WORD, primary_key=True),
        sa.Column("seq", NUMBER, primary_key=True),
        sa.Column("kind", WORD, nullable=False),
        sa.Column("key", WORD, nullable=False),
        sa.Column("sha256", WORD, nullable=False),
        sa.Column("file", WORD),
        sa.Column("file_bytes", NUMBER),
        sa.Column("at_utc", sa.String, nullable=False),
        sa.Column("received_utc", sa.String, nullable=False),
        sa.Column("previous", sa.String, nullable=False),
        sa.Column("hash", sa.String, nullable=False),
        sa.Column("body", sa.Text),
    )
    op.create_index("ix_centre_items_file", "centre_items", ["file"])
    op.create_index("ix_centre_items_told", "centre_items", ["rig_id", "kind", "key"])


def _files() -> None:
    op.create_table(
        "centre_files",
        sa.Column("sha256", WORD, primary_key=True),
        sa.Column("bytes", NUMBER, nullable=False),
        sa.Column("whole_utc", sa.String, nullable=False),
        sa.Column("checked_utc", sa.String),
        sa.Column("ok", sa.Boolean, nullable=False),
    )


def _wanted() -> None:
    op.create_table(
        "centre_wanted",
        sa.Column("id", NUMBER, primary_key=True, autoincrement=True),
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), nullable=False),
        sa.Column("sha256", WORD, nullable=False),
        sa.Column("bytes", NUMBER, nullable=False),
    )
    op.create_index("ix_centre_wanted_file", "centre_wanted", ["sha256", "rig_id"], unique=True)
    op.create_index("ix_centre_wanted_rig", "centre_wanted", ["rig_id", "id"])


def _warnings() -> None:
    op.create_table(
        "centre_warnings",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG)),
        sa.Column("kind", WORD, nullable=False),
        sa.Column("subject", WORD, nullable=False),
        sa.Column("detail", sa.JSON, nullable=False),
        sa.Column("at_utc", WORD, nullable=False),
        sa.Column("again_utc", sa.String, nullable=False),
        sa.Column("times", sa.Integer, nullable=False),
        sa.Column("ended_utc", WORD),
        sa.Column("acknowledged_by", sa.String),
        sa.Column("acknowledged_utc", WORD),
    )
    op.create_index("ix_centre_warnings_of", "centre_warnings", ["rig_id", "kind", "subject"])
    op.create_index("ix_centre_warnings_open", "centre_warnings", ["acknowledged_utc", "id"])


def _participants() -> None:
    op.create_table(
        "centre_participants",
        sa.Column("code", WORD, primary_key=True),
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("side", sa.String),
        sa.Column("muscle", sa.String),
        sa.Column("archived_utc", sa.String),
        sa.Column("sessions", sa.Integer, nullable=False),
        sa.Column("recordings", sa.Integer, nullable=False),
        sa.Column("last_utc", WORD),
        sa.Column("verdict", sa.String),
    )
    op.create_index("ix_centre_participants_rig", "centre_participants", ["rig_id", "code"])


def _sessions() -> None:
    op.create_table(
        "centre_sessions",
        sa.Column("participant", WORD, primary_key=True),
        sa.Column("day", WORD, primary_key=True),
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("at_utc", sa.String, nullable=False),
        sa.Column("tests", sa.Integer, nullable=False),
        sa.Column("recordings", sa.Integer, nullable=False),
        sa.Column("model_id", sa.String),
        sa.Column("model_utc", sa.String),
        sa.Column("verdict", WORD),
        sa.Column("approved_by", sa.String),
        sa.Column("current_ma", sa.Float),
    )
    op.create_index("ix_centre_sessions_day", "centre_sessions", ["day", "participant", "rig_id"])
    op.create_index("ix_centre_sessions_rig", "centre_sessions", ["participant", "rig_id", "day"])
    op.create_index("ix_centre_sessions_verdict", "centre_sessions", ["verdict", "participant", "rig_id", "day"])


def _tests() -> None:
    op.create_table(
        "centre_tests",
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("id", WORD, primary_key=True),
        sa.Column("participant", WORD, nullable=False),
        sa.Column("kind", sa.String),
        sa.Column("state", sa.String),
        sa.Column("reason", sa.Text),
        sa.Column("recording_id", sa.String),
        sa.Column("model_id", sa.String),
        sa.Column("requested_utc", WORD, nullable=False),
        sa.Column("finished_utc", sa.String),
    )
    op.create_index("ix_centre_tests_participant", "centre_tests", ["participant", "requested_utc"])


def _recordings() -> None:
    op.create_table(
        "centre_recordings",
        sa.Column("id", NUMBER, primary_key=True, autoincrement=True),
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), nullable=False),
        sa.Column("recording_id", WORD, nullable=False),
        sa.Column("participant", WORD, nullable=False),
        sa.Column("test_id", sa.String),
        sa.Column("origin", sa.String),
        sa.Column("created_utc", WORD, nullable=False),
        sa.Column("file", WORD),
        sa.Column("file_bytes", NUMBER),
    )
    op.create_index("ix_centre_recordings_of", "centre_recordings", ["rig_id", "recording_id"], unique=True)
    op.create_index("ix_centre_recordings_participant", "centre_recordings", ["participant", "created_utc", "id"])
    op.create_index("ix_centre_recordings_rig", "centre_recordings", ["rig_id", "created_utc", "id"])
    op.create_index("ix_centre_recordings_time", "centre_recordings", ["created_utc", "id"])


def _models() -> None:
    op.create_table(
        "centre_models",
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("id", WORD, primary_key=True),
        sa.Column("participant", WORD, nullable=False),
        sa.Column("recording_id", sa.String),
        sa.Column("parent_id", sa.String),
        sa.Column("method", sa.String),
        sa.Column("effects", sa.JSON, nullable=False),
        sa.Column("verdict", sa.String),
        sa.Column("fit", sa.JSON, nullable=False),
        sa.Column("created_utc", WORD, nullable=False),
        sa.Column("file", WORD),
        sa.Column("file_bytes", NUMBER),
    )
    op.create_index("ix_centre_models_participant", "centre_models", ["participant", "created_utc"])


def _effects() -> None:
    op.create_table(
        "centre_effects",
        sa.Column("effect", WORD, primary_key=True),
        sa.Column("participant", WORD, primary_key=True),
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
    )


def _decisions() -> None:
    op.create_table(
        "centre_decisions",
        sa.Column("rig_id", sa.Integer, sa.ForeignKey(RIG), primary_key=True),
        sa.Column("sha256", WORD, primary_key=True),
        sa.Column("participant", WORD, nullable=False),
        sa.Column("model_id", sa.String, nullable=False),
        sa.Column("approved", sa.Boolean, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("at_utc", WORD, nullable=False),
    )
    op.create_index("ix_centre_decisions_participant", "centre_decisions", ["participant", "at_utc"])
