"""Side and muscle, the archive, notes, a structure that carries over, locked sessions, names without their case."""

import unicodedata

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0006", "0005"


def upgrade() -> None:
    """Add the columns and the table, and fold the names of the people who are there."""
    op.add_column("participants", sa.Column("side", sa.String(8)))
    op.add_column("participants", sa.Column("muscle", sa.String(60)))
    op.add_column("participants", sa.Column("archived_utc", sa.String(32)))
    op.add_column("tests", sa.Column("ran_by", sa.String(80)))
    op.add_column("models", sa.Column("carried_from_id", sa.String(64)))
    op.add_column("models", sa.Column("carried", sa.JSON))
    op.add_column("page_sessions", sa.Column("acted_unix_s", sa.Float))
    op.add_column("page_sessions", sa.Column("locked_unix_s", sa.Float))
    op.create_table(
        "notes",
        sa.Column("id", sa.String(40), primary_key=True),
        sa.Column("participant", sa.String(32), sa.ForeignKey("participants.code"), nullable=False, index=True),
        sa.Column("test_id", sa.String(40), sa.ForeignKey("tests.id"), index=True),
        sa.Column("at_s", sa.Float),
        sa.Column("kind", sa.String(20), nullable=False),
        sa.Column("text", sa.Text, nullable=False),
        sa.Column("by", sa.String(80), nullable=False),
        sa.Column("at_utc", sa.String(32), nullable=False),
        sa.Column("struck_by", sa.String(80)),
        sa.Column("struck_utc", sa.String(32)),
    )
    op.add_column("users", sa.Column("folded_name", sa.String(320)))
    op.create_index("ix_users_folded_name", "users", ["folded_name"])
    users = sa.table("users", sa.column("name"), sa.column("folded_name"))
    connection = op.get_bind()
    for (name,) in connection.execute(sa.select(users.c.name)).all():
        connection.execute(sa.update(users).where(users.c.name == name).values(folded_name=_folded(name)))


def _folded(name: str) -> str:
    """As `stimrig.api.people.names` did when this was written."""
    return " ".join(unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold()).split())
