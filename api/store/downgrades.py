"""The way back to the schema of version 0.1, revision by revision, in one transaction.

What the older schema can hold stays, what was made since included. What it cannot hold is set aside
(`stimrig.api.store.aside`) and comes back with the next upgrade. A new revision needs its way back here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from alembic.operations import Operations
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection

from stimrig.api.store import aside, migrations
from stimrig.api.store.aside import Shelf

OLDEST = "0012"
"""The schema of version 0.1: as far as the way back goes."""
OPEN = ("requested", "running", "sealing", "identifying")


def bring_down(connection: Connection, now_utc: str) -> list[str]:
    """Go back to `OLDEST` in the caller's transaction; what was set aside, a line each.

    Raises SchemaError: the database is newer or older, or a test goes on.
    """
    at = MigrationContext.configure(connection).get_current_revision()
    if at is None or at not in migrations.STEPS or at < OLDEST:
        raise migrations.SchemaError(f"it is of version {at}: there is no way back from it to {OLDEST}")
    tests = aside.reflected(connection, "tests")
    if connection.execute(sa.select(tests.c.id).where(tests.c.state.in_(OPEN)).limit(1)).first():
        fix = "start the service and let it follow it to its end"
        raise migrations.SchemaError(f"a test is still open; {fix}, then stop it and go back")
    if at == OLDEST:
        return []
    ended = _end_approvals(connection, now_utc)
    with Operations.context(MigrationContext.configure(connection)) as op:
        for revision in sorted((one for one in STEPS if OLDEST < one <= at), reverse=True):
            STEPS[revision](op, Shelf(connection, revision))
    migrations.set_revision(connection, OLDEST)
    return ended + aside.told(connection)


def _end_approvals(connection: Connection, now_utc: str) -> list[str]:
    """Of those in force, version 0.1 would also serve one of another site, or of several muscles."""
    held = aside.reflected(connection, "approvals")
    in_force = sa.and_(held.c.approved, sa.or_(held.c.expires_utc.is_(None), held.c.expires_utc > now_utc))
    ended = connection.execute(held.update().where(in_force).values(expires_utc=now_utc)).rowcount
    return (
        [f"{ended} × approval in force: it ends now, since version 0.1 knows no sites. Approve anew."] if ended else []
    )


def _0017(op: Operations, shelf: Shelf) -> None:
    held = aside.reflected(shelf.connection, "erasures")
    if shelf.connection.execute(sa.select(held.c.id).where(held.c.done_utc.is_(None)).limit(1)).first():
        raise migrations.SchemaError("a deletion is not done; run `stimrig retention --delete`, then go back")
    shelf.rows("identities", "account that a provider signs in: version 0.1 knows passwords and tokens only.")
    shelf.rows("erasures", "deletion of a participant: version 0.1 calls the blanked entries of its trail changed.")
    op.drop_table("identities")
    op.drop_table("erasures")


def _0016(op: Operations, shelf: Shelf) -> None:
    shelf.rows("searches", "search for an electrode: version 0.1 has no arrays.")
    op.drop_table("searches")


def _0015(op: Operations, shelf: Shelf) -> None:
    why = "participant with further channels: version 0.1 has one channel."
    shelf.columns("participants", ["channels"], why)
    _joint_models(shelf)
    op.drop_column("participants", "channels")


def _joint_models(shelf: Shelf) -> None:
    """Under a hash that is none, version 0.1 takes the file for damaged: nobody approves it, no controller gets it."""
    held = aside.reflected(shelf.connection, "models")
    for row in shelf.connection.execute(sa.select(held)).mappings():
        document = bytes(row["document"])
        if b'"kind"' in document[:500] and json.loads(document).get("kind"):
            why = "hash of a model of several muscles: version 0.1 cannot read it, and is kept from serving it."
            shelf.replace("models", dict(row), {"etag": f"set aside {row['id']}"}, why)


def _0014(op: Operations, shelf: Shelf) -> None:
    why = "rejection whose words do not say whether it was an undo: version 0.1 has its words only."
    shelf.columns("approvals", ["undone"], why, lambda row: bool(row["undone"]) != _says_undone(row))
    op.drop_column("approvals", "undone")


def _says_undone(row: Any) -> bool:
    return not row["approved"] and (row["reason"] == "undone" or row["reason"].startswith("undone: "))


def _0013(op: Operations, shelf: Shelf) -> None:
    shelf.columns(
        "participants", ["placement"], "placement of a participant's electrodes.", unless_changed=("side", "muscle")
    )
    for table in ("recordings", "approvals"):
        shelf.columns(table, ["site"], f"site of one of the {table}.", lambda _row: True)  # that it is unknown, too
    _plain_profiles(shelf)
    op.drop_index("ix_audit_subject", "audit")
    for table, column in (("participants", "placement"), ("recordings", "site"), ("approvals", "site")):
        op.drop_column(table, column)


def _plain_profiles(shelf: Shelf) -> None:
    held = aside.reflected(shelf.connection, "participants")
    for row in shelf.connection.execute(sa.select(held)).mappings().all():
        profile = row["profile"] or {}
        if "angle_set_at_utc" in profile:
            plain = {name: value for name, value in profile.items() if name != "angle_set_at_utc"}
            shelf.replace("participants", dict(row), {"profile": plain}, "time at which an angle's range was said.")


STEPS: dict[str, Callable[[Operations, Shelf], None]] = {
    name[1:]: step for name, step in globals().items() if re.fullmatch("_[0-9]{4}", name)
}
"""The way back from every revision."""
