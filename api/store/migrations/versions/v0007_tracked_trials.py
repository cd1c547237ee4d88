"""How far an approved model may be tracked, and what each trial of a controller said of the muscle."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0007", "0006"


def upgrade() -> None:
    """Add the column and the table. What was approved before allows no tracking."""
    op.add_column("approvals", sa.Column("tracking", sa.JSON))
    op.create_table(
        "tracked",
        sa.Column("test_id", sa.String(40), sa.ForeignKey("tests.id"), primary_key=True),
        sa.Column("approval_id", sa.Integer, sa.ForeignKey("approvals.id"), nullable=False, index=True),
        sa.Column("participant", sa.String(32), sa.ForeignKey("participants.code"), nullable=False),
        sa.Column("model_id", sa.String(64), sa.ForeignKey("models.id"), nullable=False),
        sa.Column("recording_id", sa.String(64)),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("outcome", sa.String(20), nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("step", sa.JSON),
        sa.Column("error_percent", sa.Float),
        sa.Column("ask", sa.Text),
        sa.Column("document", sa.LargeBinary),
        sa.Column("etag", sa.String(64)),
        sa.Column("at_utc", sa.String(32), nullable=False),
        sa.Column("delay_s", sa.Float),
    )
