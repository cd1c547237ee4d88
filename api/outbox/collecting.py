"""Collecting what the centre countersigned of the audit trail, into a file beside the database."""

from __future__ import annotations

import logging
import os

from sqlalchemy import select, tuple_

from stimrig.api.outbox import receipts
from stimrig.api.outbox.errors import RefusedError
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.settings import Settings
from stimrig.api.store import Store
from stimrig.api.store.hashes import digest
from stimrig.api.store.tables import OutboxItem

log = logging.getLogger("stimrig.outbox")


class Collecting:
    """Asks a centre for its receipts, and keeps them: a file for each centre and key, so that none are mixed up.

    Attributes
    ----------
    asked : bool
        Whether it was asked since something new was told.
    """

    def __init__(self, store: Store, settings: Settings, link: Link) -> None:
        self.store, self.link, self.asked = store, link, False
        key = settings.centre_key.get_secret_value() if settings.centre_key else ""
        self.path = settings.data_dir / f"receipts-{digest(f'{settings.centre_url} {key}')[:16]}.jsonl"
        self._after, self._row_id = ("", 0), 0
        if self.path.exists():
            self._take_up()

    def step(self) -> bool:
        """Ask for the next ones; whether there may be more. Raises PushError, but where the centre is an older one."""
        if self.asked:
            return False
        self.asked = True
        try:
            given = self.link.heads(*self._after)
            kept = self._of_ours(given)
            if kept:
                receipts.append(self.path, kept)
        except (RefusedError, OSError) as error:
            log.warning("receipts of the audit trail: %s", error)
            return False
        if given:
            self._after = (given[-1].chain, given[-1].item)
        self.asked = not kept
        return bool(kept)

    def _of_ours(self, given: list[Receipt]) -> list[Receipt]:
        """Those of items that this rig has told, each once: a centre that makes up others fills no disk."""
        place = tuple_(OutboxItem.chain, OutboxItem.seq).in_([(one.chain, one.item) for one in given])
        columns = (OutboxItem.chain, OutboxItem.seq, OutboxItem.id)
        with self.store.read() as session:
            rows = session.execute(select(*columns).where(OutboxItem.kind == "audit", place))
            ids = {(chain, seq): row_id for chain, seq, row_id in rows}
        kept = []
        for one in given:
            row_id = ids.get((one.chain, one.item), 0)
            if row_id > self._row_id:
                self._row_id = row_id
                kept.append(one)
        return kept

    def _take_up(self) -> None:
        """Go on after the last one; half a line that a loss of power left is taken away."""
        whole = self.path.read_bytes().rpartition(b"\n")
        if whole[2]:
            os.truncate(self.path, len(whole[0]) + len(whole[1]))
        for _, one in receipts.read(self.path):
            if one is not None:
                self._after = (one.chain, one.item)
