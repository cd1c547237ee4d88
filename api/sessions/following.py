"""Which service follows a test to its end: the one that began it; when that is dead, another one of the same rig."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from sqlalchemy import ColumnElement, or_
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.store import Store
from stimrig.api.store.holds import Holds, Turn
from stimrig.api.store.tables import OPEN_STATES, Test

log = logging.getLogger("stimrig.trials")
PLAYED_STATES = OPEN_STATES[:3]
LOOK_S = 3.0
"""How often it is looked for what a service that died has left."""


class Follower:
    """This service as a follower of tests.

    Parameters
    ----------
    holds : Holds
        Says which services live.
    rig : str
        What the services of this rig call it.
    """

    def __init__(self, store: Store, holds: Holds, rig: str) -> None:
        self.store, self.holds, self.rig = store, holds, rig

    def mark(self, row: Test) -> None:
        """This service begins this test."""
        row.followed_by, row.rig = self.holds.me, self.rig

    def mine(self, row: Test) -> bool:
        """Whether this service follows the test; one from before it was written down is anybody's."""
        return row.followed_by in (None, self.holds.me)

    def rig_turn(self) -> Turn:
        """Around the start of a test: of all services of this rig one starts."""
        return self.holds.turn(f"rig {self.rig}")

    def played_by_another(self) -> Test | None:
        """The test that another service of this rig plays, or has begun to."""
        if not self.store.several:
            return None
        of_others = (Test.state.in_(PLAYED_STATES), Test.rig == self.rig, Test.followed_by != self.holds.me)
        found = self.store.all(Test, *of_others, limit=1)
        return found[0] if found else None

    def left(self) -> list[Test]:
        """Open tests of this rig that nobody follows any more; from now on this service does."""
        dead = self.holds.dead({name for name in self.store.all(Test.followed_by, *self._open()) if name})
        with self.store.write() as session:
            rows = [row for row in session.query(Test).filter(*self._open()) if row.followed_by in {None, *dead}]
            for row in rows:
                self.mark(row)
        return rows

    def _open(self) -> list[ColumnElement[bool]]:
        of_others = [] if not self.store.several else [or_(Test.rig == self.rig, Test.rig.is_(None))]
        return [Test.state.in_(OPEN_STATES), *of_others]

    async def watch(self, take_up: Callable[[list[Test]], None], look_again: Callable[[], None]) -> None:
        """Show that this service lives, and take up what others leave; `look_again` is called where there is some."""
        if not self.store.several:
            return
        while True:
            await asyncio.sleep(LOOK_S)
            try:
                await asyncio.to_thread(self.holds.keep)
                left = await asyncio.to_thread(self._left_by_others)
            except SQLAlchemyError:
                log.exception("what other services left could not be read")
                continue
            if left:
                log.warning("taken up from a service that ended: %s", ", ".join(row.id for row in left))
                take_up(left)
                look_again()

    def _left_by_others(self) -> list[Test]:
        """`left`, without a transaction that writes where there is nothing."""
        followers = {name for name in self.store.all(Test.followed_by, *self._open()) if name}
        return self.left() if self.holds.dead(followers) else []
