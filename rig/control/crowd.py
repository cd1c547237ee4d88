"""Who is connected to a socket: a crowd that says nothing cannot keep out one who has something to say.

A connection that has sent no whole request yet is silent. Of the silent ones, and of those that have spoken, only so
many are kept: when another comes, the one that has been still for longest is let go. So a newcomer always gets in.
"""

from __future__ import annotations

import asyncio


class Crowd:
    """The connections of one socket, those that are silent and those that have spoken.

    Parameters
    ----------
    most_silent, most_speaking
        How many of each are kept.
    """

    def __init__(self, most_silent: int, most_speaking: int) -> None:
        self._most = {False: most_silent, True: most_speaking}
        self._members: dict[bool, dict[asyncio.BaseTransport, None]] = {False: {}, True: {}}

    def __len__(self) -> int:
        return sum(len(members) for members in self._members.values())

    def enter(self, transport: asyncio.BaseTransport) -> None:
        """A new connection."""
        self._put(transport, spoken=False)

    def spoke(self, transport: asyncio.BaseTransport) -> None:
        """It has sent a whole request."""
        self.leave(transport)
        self._put(transport, spoken=True)

    def leave(self, transport: asyncio.BaseTransport) -> None:
        """It is gone."""
        for members in self._members.values():
            members.pop(transport, None)

    def _put(self, transport: asyncio.BaseTransport, spoken: bool) -> None:
        members = self._members[spoken]
        members[transport] = None  # at the end: dictionaries keep their order
        if len(members) > self._most[spoken]:
            longest = next(iter(members))
            del members[longest]
            longest.abort() if isinstance(longest, asyncio.WriteTransport) else longest.close()
