"""A controller's key falls with the token of whoever made it."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0009", "0008"


def upgrade() -> None:
    """Add the column. The keys that are there end with their day."""
    op.add_column("tokens", sa.Column("made_by", sa.String(64)))
