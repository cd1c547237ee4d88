"""People with passwords, and the end of an approval.

Databases from before versions were kept have some of this already, and none says which: what is there stays.
"""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0002", "0001"


def upgrade() -> None:
    """Add what is not there."""
    approvals = sa.inspect(op.get_bind()).get_columns("approvals")
    if "expires_utc" not in {column["name"] for column in approvals}:
        op.add_column("approvals", sa.Column("expires_utc", sa.String(32)))
    op.create_table(
        "users",
        sa.Column("name", sa.String(80), primary_key=True),
        sa.Column("password_hash", sa.String(200), nullable=False),
        sa.Column("token_hash", sa.String(64), sa.ForeignKey("tokens.hash"), nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False),
        sa.Column("changed_utc", sa.String(32), nullable=False),
        if_not_exists=True,
    )
    op.create_table(
        "confirmations",
        sa.Column("session_hash", sa.String(64), primary_key=True),
        sa.Column("at_unix_s", sa.Float, nullable=False),
        if_not_exists=True,
    )
