"""The places that people sign in from."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0003", "0002"


def upgrade() -> None:
    """Add the table."""
    op.create_table(
        "known_places",
        sa.Column("name", sa.String(80), sa.ForeignKey("users.name"), primary_key=True),
        sa.Column("place", sa.String(60), primary_key=True),
        sa.Column("at_unix_s", sa.Float, nullable=False),
    )
