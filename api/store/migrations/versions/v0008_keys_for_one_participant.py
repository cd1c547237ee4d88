"""Keys of controllers for one participant and one day, with the plan that they may play."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0008", "0007"


def upgrade() -> None:
    """Add the columns. The tokens that are there are bound to nobody."""
    op.add_column("tokens", sa.Column("participant", sa.String(32)))
    op.add_column("tokens", sa.Column("plan", sa.JSON))
