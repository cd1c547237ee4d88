"""A session that nobody touches locks: its pages ask for the password again, and nothing else is asked anew.

Only a person's actions count, as `api.web.guards` tells them from what scripts ask for by themselves. Times of actions
are kept in memory and written down now and then, so that no page waits for the disk; a lock holds over a restart.
"""

from __future__ import annotations

import threading

from sqlalchemy import select

from stimrig.api.clock import Clock
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import PageSession

FLUSH_S = 15.0
"""How often the times of the last actions are written down; so much of them is lost with a process that is killed."""


class IdleLock:
    """Which sessions are locked.

    Parameters
    ----------
    store : Store
        Holds the sessions.
    clock : Clock
        Idle times are measured on it.
    after_min : float
        A session locks after so many minutes without an action; 0: never by itself.
    """

    def __init__(self, store: Store, clock: Clock, after_min: float) -> None:
        self.store, self.clock, self.after_s = store, clock, after_min * 60
        self._acted: dict[str, float] = {}
        self._locked_by_hand: set[str] = set()
        self._lock = threading.Lock()

    def locked(self, row: PageSession) -> bool:
        """Whether this session has to be unlocked first."""
        if row.locked_unix_s is not None:
            return True
        return bool(self.after_s) and self.clock.unix_s() - self._last(row) > self.after_s

    def left_s(self, row: PageSession) -> float | None:
        """Until it locks; None where it never does."""
        return max(0.0, self._last(row) + self.after_s - self.clock.unix_s()) if self.after_s else None

    def _last(self, row: PageSession) -> float:
        return max(row.acted_unix_s or row.created_unix_s, self._acted.get(row.hash, 0.0))

    def acted(self, session_hash: str) -> None:
        """A person has just done something in this session, which is not locked."""
        with self._lock:
            self._acted[session_hash] = self.clock.unix_s()

    def watches(self, session_hash: str) -> None:
        """A live view of a running test holds the lock off, but not the one that a person asked for."""
        if session_hash not in self._locked_by_hand:
            self.acted(session_hash)

    def lock(self, session_hash: str, by: str) -> None:
        """Lock it now."""
        self._locked_by_hand.add(session_hash)
        self._change(session_hash, self.clock.unix_s(), by, "lock")

    def unlock(self, session_hash: str, by: str) -> None:
        """The person is back."""
        self._change(session_hash, None, by, "unlock")
        self._locked_by_hand.discard(session_hash)

    def _change(self, session_hash: str, locked_unix_s: float | None, by: str, action: str) -> None:
        with self.store.write() as session:
            row = session.get(PageSession, session_hash)
            if row is not None:
                row.locked_unix_s, row.acted_unix_s = locked_unix_s, self.clock.unix_s()
                audit.write(session, self.clock.utc(), by, action, "page")

    def flush(self) -> None:
        """Write the times of the last actions down."""
        with self._lock:
            acted = dict(self._acted)
        if not acted:
            return
        with self.store.write() as session:
            for row in session.scalars(select(PageSession).where(PageSession.hash.in_(acted))):
                row.acted_unix_s = max(row.acted_unix_s or 0.0, acted[row.hash])
        with self._lock:  # what came meanwhile stays for the next time
            self._acted = {key: at_s for key, at_s in self._acted.items() if acted.get(key) != at_s}
