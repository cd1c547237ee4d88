"""Telling the centre of items: where it stands, what it lacks, and a chain that begins anew after a backup."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from typing import Any

from sqlalchemy import distinct, func, select

from stimrig.api.clock import Clock, unix_of, utc_label
from stimrig.api.outbox import chain
from stimrig.api.outbox.chain import NOWHERE, Head, Position
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.messages import MOST_ITEMS, RefusedError, WrongAnswerError
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import OutboxItem

MOST_BYTES = 3_500_000
AROUND_ITEM = 700
"""Bytes of an item beside its body, at most."""
ANEW_AFTER_S = 3600.0
"""A chain that began after a backup is not given up for the next one sooner: a centre may be wrong, too."""
ANEW_LONGER, LATE_S = 4.0, 30 * 86400.0
"""The next one has to wait so many times longer, for each that began in these last days: all is kept here each time."""
COLUMNS = ("seq", "kind", "key", "body", "sha256", "file", "file_bytes", "at_utc", "previous", "hash")
log = logging.getLogger("stimrig.outbox")


class Telling:
    """Tells a centre of the newest chain.

    `at`: where the centre stands; None: it has to be asked. `reached`: chain and number of the newest item that the
    centre is known to have.
    """

    def __init__(self, store: Store, clock: Clock, link: Link, about: Callable[[], dict[str, Any]]) -> None:
        self.store, self.clock, self.link, self.about = store, clock, link, about
        self.at: Position | None = None
        self.reached: tuple[str, int] | None = None
        self._out_of_order = False
        self._counted: tuple[Head | None, int, int] = (None, 0, 0)
        """Files that the items after a place name: counted once for each."""

    def head(self) -> Head | None:
        with self.store.read() as session:
            return chain.head(session)

    def hello(self) -> bool:
        """Say who is there and learn where the centre stands; whether a chain was begun anew.

        Before so much is sent again it is asked once more. Raises WrongAnswerError where it then says something else.
        """
        begun = self._hello(None)
        return begun if isinstance(begun, bool) else bool(self._hello(begun))

    def _hello(self, before: Position | None) -> bool | Position:
        """`before`: a place that the rig does not know, as the centre has just said it; such a place as the answer."""
        head = self.head() or self._first()
        self.at = None
        given = self.link.hello({"chain": head.chain, "seq": head.seq, "hash": head.hash, **self.about()})
        with self.store.read() as session:
            known = chain.at(session, head.chain, given.seq)
        if known == given.hash:
            self._stands(head.chain, given)
            return False
        if before is None:
            return given
        if before != given:
            raise WrongAnswerError(f"{self.link.url}: says each time that it stands elsewhere, never in the chain")
        self._begin_anew(head, given)
        return True

    def send(self, share: float = 1.0) -> int:
        """Send the next items, at most `share` of a batch; how many the centre took."""
        head = self.head()
        if head is None or self.at is None or self.at.seq >= head.seq:
            return 0
        before = self.at
        batch = self._after(head.chain, before.seq, share)
        if not batch:
            raise WrongAnswerError(f"the rig's chain has no item {before.seq + 1}; restore its database from a backup")
        self.at = None  # unless it answers as it should, it is asked again
        try:
            given = self.link.items(head.chain, batch)
        except RefusedError as error:
            self._go_on_from(head, error)
            return self.send(share)
        if given != Position(batch[-1]["seq"], batch[-1]["hash"]):
            raise WrongAnswerError(f"{self.link.url}: answered another place than that of the last item sent")
        self._out_of_order = False
        self._stands(head.chain, given)
        return len(batch)

    def waiting(self) -> tuple[int, int]:
        """How many items the centre lacks, as far as known, and how many files those name."""
        with self.store.read() as session:
            head = chain.head(session)
            if head is None:
                return (0, 0)
            seq = self.reached[1] if self.reached and self.reached[0] == head.chain else 0
            if self._counted[:2] != (head, seq):
                of = select(func.count(distinct(OutboxItem.file))).where(
                    OutboxItem.chain == head.chain, OutboxItem.seq > seq, OutboxItem.file.is_not(None)
                )
                self._counted = (head, seq, session.scalar(of) or 0)
        return (max(0, head.seq - seq), self._counted[2])

    def _stands(self, name: str, given: Position) -> None:
        self.at, self.reached = given, (name, given.seq)

    def _first(self) -> Head:
        """The chain begins, before there is anything to tell."""
        with self.store.write() as session:
            return chain.head(session) or chain.begin(session, self.clock.utc())

    def _after(self, name: str, seq: int, share: float) -> list[dict[str, Any]]:
        """The items after a place, no more than one batch."""
        most = max(1, int(MOST_ITEMS * share))
        columns = [getattr(OutboxItem, column) for column in COLUMNS]
        of = select(*columns).where(OutboxItem.chain == name, OutboxItem.seq > seq).order_by(OutboxItem.seq).limit(most)
        batch: list[dict[str, Any]] = []
        left = int(MOST_BYTES * share)
        with self.store.read() as session:
            for row in session.execute(of.execution_options(yield_per=50)).mappings():
                left -= len(row["body"].encode()) + AROUND_ITEM
                if batch and left < 0:
                    break
                batch.append({**row, "body": json.loads(row["body"])})
        return batch

    def _go_on_from(self, head: Head, error: RefusedError) -> None:
        """The centre stands elsewhere than it said: once it is believed, if that is a place of ours."""
        if error.code != "out-of-order" or self._out_of_order:
            self._out_of_order = False
            raise error
        seq = error.number("seq")
        with self.store.read() as session:
            known = chain.at(session, head.chain, seq)
        if known is None:
            raise WrongAnswerError(f"{self.link.url}: asks for what follows item {seq}, which the rig does not have")
        self._out_of_order = True
        self.at = Position(seq, known)

    def _begin_anew(self, head: Head, given: Position) -> None:
        """The rig's database was restored from a backup: all that it holds is told again, in a chain of its own."""
        with self.store.write() as session:
            if chain.head(session) != head:
                return  # something was written meanwhile: it is looked at again
            now = self.clock.utc()
            if self._anew_lately(session, head):
                raise WrongAnswerError(
                    f"{self.link.url}: stands at item {given.seq}, which the rig does not have, though its chain began "
                    "anew a short while ago; is it another rig's key?"
                )
            begun = chain.begin(session, now, head)
            said = {"after": head.chain, "after_seq": head.seq, "centre_seq": given.seq}
            audit.write(session, now, "service", "begin outbox anew", begun.chain, **said)
        log.warning("the centre knows more than this database, as after a backup: everything is told again")
        self._stands(begun.chain, NOWHERE)

    def _anew_lately(self, session: Any, head: Head) -> bool:
        """Whether the chain began anew a short while ago; each time of late makes this longer."""
        since = utc_label(self.clock.unix_s() - LATE_S)
        of = select(OutboxItem.body).where(OutboxItem.kind == chain.BEGIN, OutboxItem.at_utc > since)
        times = sum(json.loads(body)["after"] is not None for body in session.scalars(of))
        began = select(OutboxItem.body, OutboxItem.at_utc).where(OutboxItem.chain == head.chain, OutboxItem.seq == 1)
        body, at_utc = session.execute(began).one()
        wait_s = ANEW_AFTER_S * ANEW_LONGER ** max(0, times - 1)
        return json.loads(body)["after"] is not None and self.clock.unix_s() - unix_of(at_utc) < wait_s
