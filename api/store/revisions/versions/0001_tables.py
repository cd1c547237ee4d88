"""Create all tables.

Until the tables are settled (issue 63) this revision creates whatever `stimrig.api.store.tables` defines, so a change
there needs no change here. It is replaced by explicit `op.create_table` calls at the end of that work; from then on
every change of the tables needs a revision of its own.
"""

from alembic import op

from stimrig.api.store.tables import Table

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create the tables of an empty database."""
    Table.metadata.create_all(op.get_bind(), checkfirst=False)
