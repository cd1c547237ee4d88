"""Heads of the rigs' audit trails: each countersigned, and compared with those that came before (decision 0015)."""

from __future__ import annotations

import json
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from sqlalchemy import func, select, tuple_
from sqlalchemy.orm import Session, aliased

from stimrig.api.centre import warnings
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.store import Store
from stimrig.api.store.centre_tables import CentreChain, CentreItem, CentreRig, CentreWarning

MOST = 500
KIND = "audit"


class Heads:
    """Countersigns what rigs have told of their trails; the items are kept as they came, a receipt is made of them.

    `seed`: the private key.
    """

    def __init__(self, store: Store, seed: bytes) -> None:
        self.store, self._key = store, Ed25519PrivateKey.from_private_bytes(seed)
        self.key = self._key.public_key().public_bytes_raw().hex()

    def after(self, rig: CentreRig, chain: str, item: int) -> list[dict[str, Any]]:
        """Receipts of a rig in the order in which they were told, after one of them, at most 500."""
        twin = aliased(CentreItem)
        same = (twin.rig_id == rig.id, twin.kind == KIND, twin.key == CentreItem.key, twin.sha256 == CentreItem.sha256)
        body = select(func.max(twin.body)).where(*same).scalar_subquery()  # it is kept once
        place = (CentreChain.begun_utc, CentreItem.chain, CentreItem.seq)
        joined = (CentreChain.rig_id == CentreItem.rig_id) & (CentreChain.chain == CentreItem.chain)
        query = select(CentreItem.chain, CentreItem.seq, CentreItem.received_utc, body).join(CentreChain, joined)
        query = query.where(CentreItem.rig_id == rig.id, CentreItem.kind == KIND).order_by(*place).limit(MOST)
        with self.store.read() as session:
            begun = session.get(CentreChain, (rig.id, chain))
            if begun is not None:
                query = query.where(tuple_(*place) > tuple_(begun.begun_utc, chain, item))
            rows = session.execute(query).all()
        return [made for row in rows if (made := self._signed(rig.name, *row)) is not None]

    def _signed(self, rig: str, chain: str, item: int, received_utc: str, body: str) -> dict[str, Any] | None:
        said = json.loads(body or "{}")
        if not readable(said):
            return None
        plain = Receipt(
            seq=said["seq"], hash=said["hash"], noted_utc=received_utc, at_utc=said["at_utc"], rig=rig, chain=chain,
            item=item, key=self.key,
        )  # fmt: skip
        return plain.model_dump() | {"signature": self._key.sign(plain.signed).hex()}


def readable(said: dict[str, Any]) -> bool:
    try:
        Receipt(seq=said["seq"], hash=said["hash"], noted_utc="", at_utc=said["at_utc"])
    except (KeyError, ValueError):
        return False
    return True


def compare(session: Session, now_utc: str, rig: CentreRig, said: dict[str, Any]) -> None:
    """Warn where an entry is told with another hash than before, or follows another one than was told.

    Of a chain of items that was given up, after a restore, only what claims to be as old as what stood there.
    """
    seq = said["seq"]
    query = select(CentreItem.chain, CentreItem.key, CentreItem.sha256, CentreItem.body)
    query = query.where(CentreItem.rig_id == rig.id, CentreItem.kind == KIND)
    rows = session.execute(query.where(CentreItem.key.in_([str(seq), str(seq - 1)]))).all()
    bodies = {row.sha256: json.loads(row.body) for row in rows if row.body is not None}
    for row in rows:
        known, here = bodies.get(row.sha256, {}), row.chain == rig.chain
        expected = said["hash"] if row.key == str(seq) else said.get("previous_hash")
        old = row.key == str(seq) and said["at_utc"] <= str(known.get("at_utc"))
        if expected is not None and known.get("hash") not in (None, expected) and (here or old):
            _warn(session, now_utc, rig.id, int(row.key))


def _warn(session: Session, now_utc: str, rig_id: int, seq: int) -> None:
    """Of one change, be it of many entries, one warning: about the first of them."""
    of = (CentreWarning.rig_id == rig_id, CentreWarning.kind == KIND, CentreWarning.acknowledged_utc.is_(None))
    row = session.scalars(select(CentreWarning).where(*of).limit(1)).first()
    if row is None:
        warnings.tell(session, now_utc, rig_id, KIND, str(seq), seq=seq)
    elif seq < row.detail["seq"]:
        row.detail = {"seq": seq}
