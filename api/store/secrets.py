"""Secrets that all services on a database share, so that a page of one is good at another."""

from __future__ import annotations

from pathlib import Path
from secrets import token_bytes

from stimrig.api.store.database import Store
from stimrig.api.store.tables import Secret

LENGTH = 32


def shared(store: Store, name: str, before: Path | None = None) -> bytes:
    """A secret of `LENGTH` bytes: read, or drawn at the first start.

    Parameters
    ----------
    name : str
        What it is for.
    before : Path, optional
        The file in which an older version kept it: pages that are open stay good over the upgrade.
    """
    with store.write() as session:
        row = session.get(Secret, name)
        if row is None:
            kept = before.read_bytes() if before is not None and before.is_file() else b""
            row = Secret(name=name, value=kept if len(kept) == LENGTH else token_bytes(LENGTH))
            session.add(row)
        if before is not None:
            before.unlink(missing_ok=True)
    return row.value
