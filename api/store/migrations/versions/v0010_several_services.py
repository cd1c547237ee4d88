"""Several services on one database."""

revision, down_revision = "0010", "0009"


def upgrade() -> None:
    """Nothing yet."""
