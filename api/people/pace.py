"""Guesses of passwords and tokens are held to a pace, and nobody's guesses lock another person out.

Some wrong tries of a key are free, then each doubles the wait, up to five minutes. Memory is bounded, and no flood of
keys makes it forget one that still counts: newcomers share one count while there is no room.
"""

from __future__ import annotations

import ipaddress
import threading
from collections.abc import Hashable
from dataclasses import dataclass

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError

LONGEST_WAIT_S = 300.0
FORGOTTEN_S = 3600.0
"""A key counts for so long after its last try: who waits for it to be forgotten is no faster than who tries on."""
MOST_KEYS = 10_000
SWEEP_S = 1.0
FREE_TRIES, FREE_FOR_A_NAME, MOST_PROVEN = 5, 20, 1000
Key = tuple[Hashable, ...]
"""Key of counted attempts; the first part is its kind: `pair`, `known pair`, `name`, `place`, `session` or `token`."""


@dataclass
class Count:
    """Tries of a key, until when the next one waits, and when the last one was."""

    tries: int = 0
    until_s: float = 0.0
    last_s: float = 0.0


class Guesses:
    """Wrong tries by key; waits are measured on `clock`. So many keys of each kind are told apart."""

    def __init__(self, clock: Clock, most_keys: int = MOST_KEYS) -> None:
        self.clock, self.most_keys = clock, most_keys
        self._counts: dict[Hashable, dict[Key, Count]] = {}
        self._swept_s = -SWEEP_S
        self._proven: set[str] = set()
        self._lock = threading.Lock()

    def admit(self, *keys: Key) -> None:
        """Count a try for each key before it is known to be wrong. Raises ApiError: 429 with `Retry-After`."""
        with self._lock:
            refuse(max(self.wait_s(key) for key in keys))
            for key in keys:
                self.count(key)

    def was_right(self, key: Key, *others: Key) -> None:
        """Let the key start anew; uncount the try for the others, where strangers' tries still count."""
        with self._lock:
            self._of_kind(key).pop(key, None)
            for other in others:
                if (count := self._of_kind(other).get(self._slot(other))) is not None:
                    count.tries, count.until_s = max(0, count.tries - 1), 0.0

    def chosen_token(self, place: str) -> None:
        """Admit a token that a person chose, which may be guessed: while guesses wait it opens only where it did."""
        with self._lock:
            if place not in self._proven:
                refuse(self.wait_s(("token", place)))
            if len(self._proven) >= MOST_PROVEN:
                self._proven.clear()
            self._proven.add(place)

    def wait_s(self, key: Key) -> float:
        """Return how long the next try of a key has to wait, s."""
        count = self._of_kind(key).get(self._slot(key))
        return 0.0 if count is None else max(0.0, count.until_s - self.clock.monotonic_s())

    def count(self, key: Key) -> None:
        """Count a try."""
        now = self.clock.monotonic_s()
        count = self._of_kind(key).setdefault(self._slot(key), Count())
        if now - count.last_s > FORGOTTEN_S:
            count.tries = 0
        count.tries, count.last_s = count.tries + 1, now
        over = count.tries - (FREE_FOR_A_NAME if key[0] == "name" else FREE_TRIES)
        if over >= 0:
            count.until_s = now + min(LONGEST_WAIT_S, 2.0 ** min(over, 20))

    def _of_kind(self, key: Key) -> dict[Key, Count]:
        return self._counts.setdefault(key[0], {})

    def _slot(self, key: Key) -> Key:
        counts, now = self._of_kind(key), self.clock.monotonic_s()
        if key in counts or len(counts) < self.most_keys:
            return key
        if now - self._swept_s >= SWEEP_S:
            self._swept_s = now
            for old in [name for name, count in counts.items() if now - count.last_s > FORGOTTEN_S]:
                del counts[old]
        return key if len(counts) < self.most_keys else key[:1]


def password_keys(name: str, place: str, known: bool) -> list[Key]:
    """Return what a password for a name counts for.

    A person who has signed in from a place before is counted there apart from everybody else. A stranger's try counts
    for name and place together, for the name, whether there is such a person or not, and for the place.
    """
    if known:
        return [("known pair", place, name)]
    return [("pair", place, name), ("name", name), ("place", place)]


def refuse(wait_s: float, title: str = "Too many wrong tries") -> None:
    """Raise 429 with `Retry-After` where there is something to wait for."""
    if wait_s > 0:
        problem = ApiError(429, "too-many-tries", title, f"Try again in {wait_s:.0f} s.")
        problem.headers["Retry-After"] = str(int(wait_s) + 1)
        raise problem


def place_of(address: str) -> str:
    """Return the origin of a try: the IPv4 address, or the /64 network of an IPv6 address."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address[:60]
    if isinstance(parsed, ipaddress.IPv4Address):
        return str(parsed)
    return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False).network_address)
