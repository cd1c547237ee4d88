"""What is in doubt about an upload."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0004", "0003"


def upgrade() -> None:
    """Add the column."""
    op.add_column("recordings", sa.Column("warnings", sa.JSON))
