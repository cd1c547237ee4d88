"""Why the centre was not told something: each with one line for people."""

from __future__ import annotations


class PushError(Exception):
    """Something was not told.

    Attributes
    ----------
    state : str
        What it is called in the status (`api.outbox.status`).
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
