"""A site for models and approvals, and the audit trail by its subjects: what has changed since something was seen."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0013", "0012"


def upgrade() -> None:
    """Add columns and index. What was approved or uploaded before is of the site that the participant has now."""
    op.add_column("participants", sa.Column("placement", sa.String))
    op.add_column("recordings", sa.Column("site", sa.JSON))
    op.add_column("approvals", sa.Column("site", sa.JSON))
    op.create_index("ix_audit_subject", "audit", ["subject"])
    connection = op.get_bind()
    people = sa.table("participants", sa.column("code"), sa.column("side"), sa.column("muscle"))
    for code, side, muscle in connection.execute(sa.select(people)).all():
        for name in ("recordings", "approvals"):
            rows = sa.table(name, sa.column("participant"), sa.column("site", sa.JSON))
            of_person = sa.update(rows).where(rows.c.participant == code)
            connection.execute(of_person.values(site=[side, muscle, None]))
