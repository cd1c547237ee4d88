"""A place in the line of revisions."""

revision, down_revision = "0010", "0009"


def upgrade() -> None:
    """Nothing."""
