"""The right to stop: whoever has the stop button in view may press it.

A page that shows the button carries a signed value in its form. It allows a stop and nothing else, and asks neither
the database nor a session: it outlives sign-out, the session's end, a new password and a revoked token.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import json
from collections.abc import Collection

from stimrig.api.clock import Clock

RIGHT_S = 24 * 3600.0
"""A page's right holds this long, which no session exceeds, and beyond that while the test that it shows is running."""
LONGEST = 1000


class StopRights:
    """Gives rights to stop and knows them again.

    Parameters
    ----------
    key : bytes
        The service's own; a restart keeps it, so that the pages that are open stay good.
    clock : Clock
        Their age is measured on it.
    """

    def __init__(self, key: bytes, clock: Clock) -> None:
        self._key, self.clock = key, clock

    def give(self, name: str, test_id: str | None) -> str:
        """A right for the page of `name`, which shows this test or none."""
        said = [name, test_id, round(self.clock.unix_s())]
        words = json.dumps(said, separators=(",", ":"), ensure_ascii=False).encode()
        return f"{_text(words)}.{_text(self._sign(words))}"

    def holder(self, text: str | None, running: Collection[str | None] = ()) -> str | None:
        """Whose page it was given to; None where it is no right, or none any more."""
        if not text or len(text) > LONGEST or not text.isascii():
            return None
        words, _, mark = text.partition(".")
        try:
            said = base64.urlsafe_b64decode(words + "=" * (-len(words) % 4))
            signed = base64.urlsafe_b64decode(mark + "=" * (-len(mark) % 4))
        except (binascii.Error, ValueError):
            return None
        if not hmac.compare_digest(signed, self._sign(said)):
            return None
        name, test_id, given_s = json.loads(said)
        young = self.clock.unix_s() - given_s <= RIGHT_S
        return name if young or (test_id is not None and test_id in running) else None

    def _sign(self, words: bytes) -> bytes:
        return hmac.digest(self._key, b"stop\0" + words, "sha256")


def _text(value: bytes) -> str:
    return base64.urlsafe_b64encode(value).decode().rstrip("=")
