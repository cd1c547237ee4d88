"""Why the centre was not told something, each with one line for people; and how long to wait after it."""

from __future__ import annotations

import random

FIRST_S, LONGEST_S = 1.0, 300.0


class PushError(Exception):
    """Something was not told.

    Attributes
    ----------
    state : str
        What it is called in the status (`stimrig.api.outbox.status`).
    """

    state = "refused"


class UnreachableError(PushError):
    """No answer came."""

    state = "unreachable"


class KeyRefusedError(PushError):
    """The centre does not know the rig's key, or not any more."""

    state = "key-refused"


class WrongAnswerError(PushError):
    """What answered does not speak as a centre does."""

    state = "wrong-answer"


class RefusedError(PushError):
    """The centre refused what was sent.

    Parameters
    ----------
    code : str
        Id of the problem, as `out-of-order`.
    said : dict
        The problem's members.
    """

    def __init__(self, words: str, code: str, said: dict[str, object]) -> None:
        super().__init__(words)
        self.code, self.said = code, said


class BucketError(PushError):
    """The centre cannot keep files at the moment: its bucket is full or gone."""

    state = "bucket-failed"


class Backoff:
    """Waits from 1 s to 5 min, longer each time, and by chance up to half shorter: never all rigs at once."""

    def __init__(self, chance: random.Random) -> None:
        self.chance, self.failures = chance, 0

    def next_s(self) -> float:
        """The next wait, s."""
        wait_s = min(LONGEST_S, FIRST_S * 2.0 ** min(self.failures, 20))
        self.failures += 1
        return max(FIRST_S, wait_s * self.chance.uniform(0.5, 1.0))

    def reset(self) -> None:
        """It went well."""
        self.failures = 0
