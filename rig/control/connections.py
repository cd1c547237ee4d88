"""Limits the connections of a socket, so that idle clients cannot keep out an active one.

A connection that has not yet sent a complete request is silent; the others are active. Both kinds are limited in
number: a new connection closes the one of its kind that has been idle longest. So a new client can always connect.
"""

from __future__ import annotations

import asyncio


class Connections:
    """The connections of one socket, silent and active ones.

    Parameters
    ----------
    max_silent, max_active
        Largest number of each kind.
    """

    def __init__(self, max_silent: int, max_active: int) -> None:
        self._most = {False: max_silent, True: max_active}
        self._members: dict[bool, dict[asyncio.BaseTransport, None]] = {False: {}, True: {}}

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
        members = self._members[spoken]
        members[transport] = None  # the newest is last: dictionaries keep their order
        if len(members) > self._most[spoken]:
            longest = next(iter(members))
            del members[longest]
            longest.abort() if isinstance(longest, asyncio.WriteTransport) else longest.close()
