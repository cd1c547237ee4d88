"""What a centre is told: a chain of items, written with the rows that they tell of."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0011", "0010"


def upgrade() -> None:
    """Add the table, empty: what is there already is put in once a centre is configured."""
    op.create_table(
        "outbox",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("chain", sa.String, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("key", sa.String, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.Column("sha256", sa.String, nullable=False),
        sa.Column("file", sa.String, index=True),
        sa.Column("file_bytes", sa.BigInteger),
        sa.Column("at_utc", sa.String, nullable=False),
        sa.Column("previous", sa.String, nullable=False),
        sa.Column("hash", sa.String, nullable=False),
    )
    op.create_index("ix_outbox_chain_seq", "outbox", ["chain", "seq"], unique=True)
    op.create_index("ix_outbox_kind_key", "outbox", ["kind", "key"])
