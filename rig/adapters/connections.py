"""Limits the connections of a socket, so that idle clients cannot keep out an active one.

A connection that has not yet sent a complete request is silent; the others are active. Both kinds are limited in
number: a new connection closes the one of its kind that has been idle longest, but none whose request may not have been
read yet. So a client that connects is heard, however many come at once.
"""

from __future__ import annotations

import asyncio
import time

GRACE_S = 2.0
"""So long after it came, or after its last request, a connection is closed for no other, unless too many come."""
MOST_AT_ONCE = 600
"""Of a kind: beyond it a new one closes the oldest. More than a socket's backlog, so that was read by then."""


class Connections:
    """The connections of one socket, silent and active ones.

    Parameters
    ----------
    max_silent, max_active
        Number of each kind that is kept.
    """

    def __init__(self, max_silent: int, max_active: int) -> None:
        self._most = {False: max_silent, True: max_active}
        self._members: dict[bool, dict[asyncio.BaseTransport, float]] = {False: {}, True: {}}

    def __len__(self) -> int:
        return sum(len(members) for members in self._members.values())

    def enter(self, transport: asyncio.BaseTransport) -> None:
        """Add a new connection."""
        self._put(transport, spoken=False)

    def spoke(self, transport: asyncio.BaseTransport) -> None:
        """Note that it sent a complete request."""
        self.leave(transport)
        self._put(transport, spoken=True)

    def leave(self, transport: asyncio.BaseTransport) -> None:
        """Remove a closed connection."""
        for members in self._members.values():
            members.pop(transport, None)

    def _put(self, transport: asyncio.BaseTransport, spoken: bool) -> None:
        members, now_s = self._members[spoken], time.monotonic()
        members[transport] = now_s  # the newest is last: dictionaries keep their order
        longest, since_s = next(iter(members.items()))
        many = len(members) > self._most[spoken] and now_s - since_s >= GRACE_S
        if many or len(members) > MOST_AT_ONCE:
            del members[longest]
            longest.abort() if isinstance(longest, asyncio.WriteTransport) else longest.close()
