"""Several services on one database: which of them follows a test, at which rig, and secrets that they share.

PostgreSQL holds columns to their lengths, which SQLite never did: there, lengths go. What a text may hold is checked
where it comes in.
"""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0010", "0009"


def upgrade() -> None:
    """Add the columns and the table. The tests that are open are followed by nobody."""
    op.add_column("tests", sa.Column("followed_by", sa.String))
    op.add_column("tests", sa.Column("rig", sa.String))
    op.create_table(
        "secrets",
        sa.Column("name", sa.String, primary_key=True),
        sa.Column("value", sa.LargeBinary, nullable=False),
    )
    connection = op.get_bind()
    if connection.dialect.name == "postgresql":
        _forget_lengths(connection)


def _forget_lengths(connection: sa.Connection) -> None:
    seen = sa.inspect(connection)
    for table in seen.get_table_names():
        for column in seen.get_columns(table):
            if getattr(column["type"], "length", None):
                op.alter_column(table, column["name"], type_=sa.String)
