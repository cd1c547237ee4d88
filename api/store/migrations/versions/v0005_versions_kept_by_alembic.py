"""From here on Alembic keeps the version.

A stimrig from before Alembic reads `schema_version` alone. The number that it does not know makes it refuse the
database, instead of taking it for one without a version.
"""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0005", "0004"


def upgrade() -> None:
    """Leave a number that only this version knows."""
    table = op.create_table("schema_version", sa.Column("version", sa.Integer, primary_key=True), if_not_exists=True)
    op.bulk_insert(table, [{"version": 5}])
