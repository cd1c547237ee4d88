"""Create all tables.

Before the first release this revision creates what `stimrig.api.store.tables` defines. The release replaces it by
explicit `op.create_table` calls; from then on every change of the tables needs a revision of its own.
"""

from alembic import op

from stimrig.api.store.tables import Table

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create the tables of an empty database."""
    Table.metadata.create_all(op.get_bind(), checkfirst=False)
