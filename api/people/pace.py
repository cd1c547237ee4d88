"""Guesses are held to a pace, and nobody's guesses lock another person out.

A pace counts wrong tries of a key: some are free, then each doubles the wait, up to five minutes. Memory is bounded,
and no flood of keys makes it forget one that still counts: newcomers share one count while there is no room.
"""

from __future__ import annotations

import ipaddress
import threading
from collections import OrderedDict
from dataclasses import dataclass

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError

LONGEST_WAIT_S = 300.0
FORGOTTEN_S = 3600.0
"""A key counts for so long after its last try: who waits for it to be forgotten is no faster than who tries on."""
MOST_KEYS = 10_000
SWEEP_S = 1.0
OTHERS = "\0"
"""The key that newcomers share while there is no room."""
FREE_TRIES, FREE_FOR_A_NAME = 5, 20
MOST_PROVEN = 1000


@dataclass
class Count:
    """Tries of a key, until when the next one waits, and when the last one was."""

    tries: int = 0
    until_s: float = 0.0
    last_s: float = 0.0


class Pace:
    """Wrong tries by key.

    `clock`: waits are measured on it; `free`: so many tries cost nothing; `most_keys`: so many keys are told apart.
    """

    def __init__(self, clock: Clock, free: int = FREE_TRIES, most_keys: int = MOST_KEYS) -> None:
        self.clock, self.free, self.most_keys = clock, free, most_keys
        self._counts: dict[str, Count] = {}
        self._swept_s = -SWEEP_S

    def wait_s(self, key: str) -> float:
        """Return how long the next try has to wait, s."""
        count = self._counts.get(self._slot(key))
        return 0.0 if count is None else max(0.0, count.until_s - self.clock.monotonic_s())

    def count(self, key: str) -> None:
        """Count a try."""
        now = self.clock.monotonic_s()
        count = self._counts.setdefault(self._slot(key), Count())
        if now - count.last_s > FORGOTTEN_S:
            count.tries = 0
        count.tries, count.last_s = count.tries + 1, now
        over = count.tries - self.free
        if over >= 0:
            count.until_s = now + min(LONGEST_WAIT_S, 2.0 ** min(over, 20))

    def give_back(self, key: str) -> None:
        """Uncount a try that proved right; wrong ones before it still count."""
        count = self._counts.get(self._slot(key))
        if count is not None:
            count.tries, count.until_s = max(0, count.tries - 1), 0.0

    def forget(self, key: str) -> None:
        """Forget all tries of a key."""
        self._counts.pop(key, None)

    def __len__(self) -> int:
        return len(self._counts)

    def _slot(self, key: str) -> str:
        if key in self._counts or len(self._counts) < self.most_keys:
            return key
        now = self.clock.monotonic_s()
        if now - self._swept_s >= SWEEP_S:
            self._swept_s = now
            self._counts = {name: count for name, count in self._counts.items() if now - count.last_s <= FORGOTTEN_S}
            if len(self._counts) < self.most_keys:
                return key
        return OTHERS


class Guesses:
    """Limits the rate of guesses of passwords and tokens.

    A person who has signed in from a place before is counted there apart from everybody else: what strangers try under
    that name, or from other places, doesn't matter there. A stranger's try counts for name and place together, for the
    name, whether there is such a person or not, and for the place.
    """

    def __init__(self, clock: Clock) -> None:
        self._known_pairs, self._sessions, self._tokens = Pace(clock), Pace(clock), Pace(clock)
        self._pairs, self._places = Pace(clock), Pace(clock)
        self._names = Pace(clock, FREE_FOR_A_NAME)
        self._proven: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._lock = threading.Lock()

    def password(self, name: str, place: str, known: bool) -> None:
        """Admit a password for a name, and count it. Raises ApiError: 429 with `Retry-After`."""
        self._admit(*self._password_paces(name, place, known))

    def password_was_right(self, name: str, place: str, known: bool) -> None:
        """The pair starts anew; what strangers did under the name, or from the place, still counts."""
        with self._lock:
            (pace, key), *others = self._password_paces(name, place, known)
            pace.forget(key)
            for pace, key in others:
                pace.give_back(key)

    def _password_paces(self, name: str, place: str, known: bool) -> list[tuple[Pace, str]]:
        pair = f"{place} {name}"
        return (
            [(self._known_pairs, pair)] if known else [(self._pairs, pair), (self._names, name), (self._places, place)]
        )

    def confirmation(self, session: str) -> None:
        """Admit a password given once more in a live session: only who sits in it is held back."""
        self._admit((self._sessions, session))

    def confirmation_was_right(self, session: str) -> None:
        """The session starts anew."""
        with self._lock:
            self._sessions.forget(session)

    def unknown_token(self, place: str) -> None:
        """Count a token that is none. Raises ApiError: 429 with `Retry-After`."""
        self._admit((self._tokens, place))

    def chosen_token(self, token_hash: str, place: str) -> None:
        """A token that a person chose may be guessed: where guesses are held back, it opens only if it did before."""
        with self._lock:
            pair = (token_hash, place)
            if pair not in self._proven:
                refuse(self._tokens.wait_s(place))
            self._proven[pair] = None
            self._proven.move_to_end(pair)
            if len(self._proven) > MOST_PROVEN:
                self._proven.popitem(last=False)

    def _admit(self, *paces: tuple[Pace, str]) -> None:
        with self._lock:
            refuse(max(pace.wait_s(key) for pace, key in paces))
            for pace, key in paces:
                pace.count(key)


def refuse(wait_s: float) -> None:
    """Raise 429 with `Retry-After` where there is something to wait for."""
    if wait_s > 0:
        problem = ApiError(429, "too-many-tries", "Too many wrong tries", f"Try again in {wait_s:.0f} s.")
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
