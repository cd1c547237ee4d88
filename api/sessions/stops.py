"""The stop: who may press it from a page, and what presses did, kept for the pages that tell it.

A page that shows the button carries a signed value in its form. It allows a stop and nothing else, and asks neither the
database nor a session: it outlives sign-out, the session's end, a new password and a revoked token.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import json
import secrets
from collections.abc import Collection
from dataclasses import dataclass

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.rig.messages import StopEvidence

CAPACITY = 200


@dataclass(frozen=True)
class StopResult:
    """A stop requested from a page, and its answer."""

    by: str
    reason: str
    at_utc: str
    test_id: str | None
    right: str | None  # the page's right to stop, passed on to the page with the answer
    answer: StopEvidence | ApiError  # the rig's evidence, or why the stop is not confirmed


class StopLog:
    """The newest answers, each under a key that nobody guesses: who pressed may have no session any more.

    The page that tells an answer is loaded by its key: loading it again stops nothing.
    """

    def __init__(self) -> None:
        self._results: dict[str, StopResult] = {}

    def add(self, result: StopResult) -> str:
        """Store an answer and return its key."""
        while len(self._results) >= CAPACITY:
            self._results.pop(next(iter(self._results)))
        key = secrets.token_urlsafe(16)
        self._results[key] = result
        return key

    def get(self, key: str) -> StopResult:
        """Return an answer by its key. Raises ApiError: 404 no longer stored."""
        result = self._results.get(key)
        if result is None:
            detail = (
                "The service was restarted, or many stops came after this one. The bar above shows what the rig "
                "does now. If it does not say that the rig has stopped, press Stop, or use the "
                "emergency switch on the stimulator. The audit trail lists each stop."
            )
            raise ApiError(404, "not-found", "The result of this stop is no longer kept here", detail)
        return result


RIGHT_S = 24 * 3600.0
"""A page's right holds this long, which no session exceeds, and beyond that while the test that it shows is running."""
LONGEST = 1000


class StopRights:
    """Gives rights to stop and knows them again.

    `key`: the service's own; a restart keeps it, so that the pages that are open stay good. `clock`: their age is
    measured on it.
    """

    def __init__(self, key: bytes, clock: Clock) -> None:
        self._key, self.clock = key, clock

    def give(self, name: str, test_id: str | None) -> str:
        """Issue a signed stop right for the page of `name`, which shows this test or none."""
        claims = [name, test_id, round(self.clock.unix_s())]
        words = json.dumps(claims, separators=(",", ":"), ensure_ascii=False).encode()
        return f"{_text(words)}.{_text(self._sign(words))}"

    def holder(self, text: str | None, running: Collection[str | None] = ()) -> str | None:
        """Return the user that the right was issued to; None where it is invalid or has expired."""
        if not text or len(text) > LONGEST or not text.isascii():
            return None
        words, _, mark = text.partition(".")
        try:
            claims = base64.urlsafe_b64decode(words + "=" * (-len(words) % 4))
            signed = base64.urlsafe_b64decode(mark + "=" * (-len(mark) % 4))
        except (binascii.Error, ValueError):
            return None
        if not hmac.compare_digest(signed, self._sign(claims)):
            return None
        name, test_id, given_s = json.loads(claims)
        young = self.clock.unix_s() - given_s <= RIGHT_S
        return name if young or (test_id is not None and test_id in running) else None

    def _sign(self, words: bytes) -> bytes:
        return hmac.digest(self._key, b"stop\0" + words, "sha256")


def _text(value: bytes) -> str:
    return base64.urlsafe_b64encode(value).decode().rstrip("=")
