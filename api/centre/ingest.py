"""What rigs tell: a greeting, and batches of items, read strictly, each batch one transaction (decision 0013)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError
from sqlalchemy import insert, select
from sqlalchemy.orm import Session

from stimrig.api.centre import clean, rigs, warnings
from stimrig.api.centre.project import Projector
from stimrig.api.clock import Clock, unix_of
from stimrig.api.errors import ApiError, invalid
from stimrig.api.outbox.chain import BEGIN, NOWHERE, Position, item_hash
from stimrig.api.outbox.messages import BatchIn, HelloIn, ItemIn
from stimrig.api.store import Store
from stimrig.api.store.audit import canonical, digest, storable
from stimrig.api.store.centre_tables import CentreChain, CentreItem, CentreRig, CentreWarning
from stimrig.identify.json_text import BadJson, parse

MOST_BATCH_BYTES = 4_000_000
DEEPEST = 40
"""Brackets within one another, of a batch: an item's body is in its third."""
MOST_CLOCK_S = 2.0
LEAST_DISK_SHARE, LEAST_DISK_BYTES = 0.05, 5_000_000_000
"""A disk is nearly full below both of them."""
MOST_DAMAGED = 50
"""Files that one greeting warns of."""


@dataclass(frozen=True)
class Item:
    """An item whose hashes hold; `text` is its body's canonical text."""

    sent: ItemIn
    text: str


def read(model: type[BaseModel], raw: bytes) -> Any:
    """A body of a rig, strictly. Raises ApiError: 400 no sound JSON; 422 a field does not hold."""
    try:
        return model.model_validate(parse(raw, deepest=DEEPEST))
    except BadJson as error:
        raise ApiError(400, "bad-request", "The body cannot be read", f"{error}. Send JSON (RFC 8259).") from error
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "body"
        raise invalid(f"{place[:120]}: {first['msg']}") from error


def checked(sent: ItemIn) -> Item:
    """The item, its hashes compared. Raises ApiError: 422 `hash-differs`."""
    try:
        text = canonical(sent.body)
        held = digest(text) == sent.sha256 and item_hash(sent.model_dump(exclude={"body"})) == sent.hash
    except (ValueError, RecursionError) as error:
        detail = f"Item {sent.seq} cannot be written as canonical JSON. Nothing of the batch was taken."
        raise ApiError(422, "hash-differs", "An item differs from its hash", detail) from error
    if not held:
        detail = f"Item {sent.seq} ({sent.kind}) differs from its hash. Nothing of the batch was taken."
        raise ApiError(422, "hash-differs", "An item differs from its hash", detail)
    if (sent.seq == 1) != (sent.kind == BEGIN) or (sent.file is None) != (sent.file_bytes is None):
        raise invalid(f"Item {sent.seq}: only the first item is `begin`, and a file has its length.")
    return Item(sent, text)


class Ingest:
    """Takes what rigs push.

    `store`: the centre's database; `clock`: rigs' clocks are compared with it; `most_file_bytes`: a longer file is not
    asked for.
    """

    def __init__(self, store: Store, clock: Clock, most_file_bytes: int) -> None:
        self.store, self.clock, self.most_file_bytes = store, clock, most_file_bytes

    def hello(self, rig: CentreRig, told: HelloIn) -> dict[str, Any]:
        """Note how the rig is; where the centre stands in its chain."""
        now_s = self.clock.unix_s()
        now = self.clock.utc()
        with self.store.write() as session:
            row = rigs.still(session, rig)
            row.seen_utc, row.version = now, clean.text(told.version, 80)
            row.state, row.reason = clean.text(told.state, 40), clean.text(told.reason, 400)
            row.disk_free_bytes, row.disk_total_bytes = told.disk_free_bytes, told.disk_total_bytes
            row.waiting_items, row.waiting_files = told.waiting_items, told.waiting_files
            label = clean.label(told.utc, "")
            row.clock_difference_s = round(unix_of(label) - now_s, 3) if label else None
            place = at(session, rig.id, told.chain)
            if place.seq > told.seq or (place.seq == told.seq and place.hash != told.hash):
                warnings.tell(session, now, rig.id, "restored", told.chain, seq=told.seq, centre=place.seq)
            self._states(session, row, now)
            for name in told.damaged[:MOST_DAMAGED]:
                warnings.tell(session, now, rig.id, "damaged-at-rig", clean.text(name, 80) or "?")
        return {"seq": place.seq, "hash": place.hash, "utc": now}

    def _states(self, session: Session, row: CentreRig, now: str) -> None:
        off_s = row.clock_difference_s
        clock_off = off_s is None or abs(off_s) > MOST_CLOCK_S
        warnings.holds(session, now, row.id, "clock", clock_off, difference_s=off_s)
        free, total = row.disk_free_bytes, row.disk_total_bytes
        full = free is not None and total is not None and free < min(LEAST_DISK_SHARE * total, LEAST_DISK_BYTES)
        warnings.holds(session, now, row.id, "disk", full, free_gb=round((free or 0) / 1e9, 2))
        warnings.end(session, now, "unseen", CentreWarning.rig_id == row.id)

    def take(self, rig: CentreRig, batch: BatchIn) -> Position:
        """All items of a batch, or none; where the chain stands then.

        Raises ApiError: 401 the key was revoked meanwhile; 409 `out-of-order`, `forked`; 422 `hash-differs`.
        """
        items = [checked(sent) for sent in batch.items]  # before the database is held
        now = self.clock.utc()
        try:
            with self.store.write() as session:
                return self._take(session, rigs.still(session, rig), batch.chain, items, now)
        except _Forked as fork:
            with self.store.write() as session:
                warnings.tell(session, now, rig.id, "forked", batch.chain, seq=fork.seq)
            raise ApiError(
                409, "forked", "The chain has forked",
                f"Item {fork.seq} is known with another hash. Begin a new chain.", seq=fork.at.seq, hash=fork.at.hash,
            ) from None  # fmt: skip

    def _take(self, session: Session, rig: CentreRig, chain: str, items: list[Item], now: str) -> Position:
        row = session.get(CentreChain, (rig.id, chain))
        place = Position(row.seq, row.hash) if row else NOWHERE
        begun = place
        new = []
        for item in items:
            sent = item.sent
            if sent.seq <= begun.seq:
                known = session.get(CentreItem, (rig.id, chain, sent.seq))
                if known is None or known.hash != sent.hash:
                    raise _Forked(sent.seq, begun)
                continue
            if sent.seq != place.seq + 1:
                raise out_of_order(begun)
            if sent.previous != place.hash or (sent.seq == 1 and sent.key != chain):
                raise _Forked(sent.seq, begun)
            place = Position(sent.seq, sent.hash)
            new.append(item)
        if not new:
            return place
        self._keep(session, rig.id, chain, new, now)
        if row is None:
            session.add(CentreChain(rig_id=rig.id, chain=chain, seq=place.seq, hash=place.hash, begun_utc=now))
        else:
            row.seq, row.hash = place.seq, place.hash
        projector = Projector(session, rig, now, self.most_file_bytes)
        with session.no_autoflush:
            for item in new:
                projector.take(item.sent)
        return place

    def _keep(self, session: Session, rig_id: int, chain: str, items: list[Item], now: str) -> None:
        """The items as they came; of a body that was told before, only its hash."""
        known = _known_items(session, rig_id, [item.sent for item in items])
        rows = []
        for item in items:
            sent = item.sent
            told = (sent.kind, sent.key, sent.sha256)
            fields = sent.model_dump(exclude={"body"})
            rows.append({
                **fields, "key": storable(sent.key), "at_utc": storable(sent.at_utc), "rig_id": rig_id, "chain": chain,
                "received_utc": now, "body": None if told in known else item.text,
            })  # fmt: skip
            known.add(told)
        session.execute(insert(CentreItem), rows)


class _Forked(Exception):
    """An item is known with another hash, or does not follow the one before."""

    def __init__(self, seq: int, at: Position) -> None:
        super().__init__(seq)
        self.seq, self.at = seq, at


def out_of_order(place: Position) -> ApiError:
    """409: where to go on from."""
    detail = f"The centre stands at item {place.seq}. Go on with the next one."
    return ApiError(409, "out-of-order", "Items are missing", detail, seq=place.seq, hash=place.hash)


def at(session: Session, rig_id: int, chain: str) -> Position:
    """Where a rig's chain stands."""
    row = session.get(CentreChain, (rig_id, chain))
    return Position(row.seq, row.hash) if row else NOWHERE


def _known_items(session: Session, rig_id: int, sent: list[ItemIn]) -> set[tuple[str, str, str]]:
    """Kind, key and hash of what was told before, on this chain or another."""
    keys = sorted({storable(one.key) for one in sent})
    columns = (CentreItem.kind, CentreItem.key, CentreItem.sha256)
    of = select(*columns).where(CentreItem.rig_id == rig_id, CentreItem.kind.in_({one.kind for one in sent}))
    return {tuple(row) for row in session.execute(of.where(CentreItem.key.in_(keys)).distinct())}  # pyright: ignore[reportReturnType]
