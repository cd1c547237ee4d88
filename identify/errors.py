"""One exception tree for identification: every message names the place and the mend."""

from __future__ import annotations


class IdentifyError(Exception):
    """Base of all errors of `identify`.

    Parameters
    ----------
    message : str
        One line, for a person.
    place : str
        Where: file, line and column, segment, parameter. May be empty.
    mend : str
        What to do about it. May be empty.
    """

    def __init__(self, message: str, *, place: str = "", mend: str = "") -> None:
        self.message, self.place, self.mend = message, place, mend
        super().__init__(str(self))

    def __str__(self) -> str:
        head = f"{self.place}: {self.message}" if self.place else self.message
        return f"{head}. {self.mend}" if self.mend else head


class BadRecord(IdentifyError):
    """The record can't be read, or holds what no measurement holds."""


class BadModel(IdentifyError):
    """A MODEL.json that can't be read, or that doesn't fit the request."""


class BadRequest(IdentifyError):
    """An unknown method, effect, segment or option."""


class NotIdentifiable(IdentifyError):
    """The record can't determine what was asked of it."""


class Cancelled(IdentifyError):
    """The caller's progress function asked to stop."""
