"""argon2id in threads of its own: what guesses cost fills no thread that anything else needs."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError

from stimrig.api.errors import ApiError

MOST_STRANGERS, MOST_KNOWN = 8, 64
"""So many wait at most; each takes some 0.1 s and 64 MB."""


class Lane:
    """One check at a time, and so many that wait."""

    def __init__(self, name: str, most: int) -> None:
        self.threads, self.most, self.inside = ThreadPoolExecutor(1, name), most, 0


class Passwords:
    """Hashes and checks: known people at known places in one lane, strangers in another, which may be full."""

    def __init__(self) -> None:
        self.hasher = PasswordHasher()  # argon2id, RFC 9106's parameters for little memory
        self._nobody = self.hasher.hash(secrets.token_hex(16))
        self._strangers, self._known = Lane("passwords", MOST_STRANGERS), Lane("known-passwords", MOST_KNOWN)

    @contextmanager
    def room(self, known: bool) -> Iterator[Lane]:
        """A place in the lane.

        Raises
        ------
        ApiError
            429: too many wait already.
        """
        lane = self._known if known else self._strangers
        if lane.inside >= lane.most:
            problem = ApiError(429, "too-many-tries", "Too many people sign in at once", "Try again in 2 s.")
            problem.headers["Retry-After"] = "2"
            raise problem
        lane.inside += 1
        try:
            yield lane
        finally:
            lane.inside -= 1

    async def verify(self, lane: Lane, hashed: str | None, password: str) -> bool:
        """Whether the password is right; as long a work where there is nobody of that name."""

        def check() -> bool:
            try:
                return self.hasher.verify(hashed or self._nobody, password) and hashed is not None
            except (Argon2Error, InvalidHashError):
                return False

        return await asyncio.get_running_loop().run_in_executor(lane.threads, check)

    async def hash(self, password: str) -> str:
        """What is kept of a password."""
        with self.room(known=True) as lane:
            return await asyncio.get_running_loop().run_in_executor(lane.threads, self.hasher.hash, password)

    def close(self) -> None:
        """Let the threads go."""
        for lane in (self._strangers, self._known):
            lane.threads.shutdown(wait=False, cancel_futures=True)
