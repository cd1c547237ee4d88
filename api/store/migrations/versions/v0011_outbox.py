"""A place in the line of revisions."""

revision, down_revision = "0011", "0010"


def upgrade() -> None:
    """Nothing."""
