"""The exceptions of identification. Every message says what is wrong, where, and what to do."""

from __future__ import annotations


class IdentifyError(Exception):
    """Base of all errors of `identify`.

    Parameters
    ----------
    message : str
        What is wrong, in one line.
    place : str
        Where: file, line and column, segment, parameter. May be empty.
    fix : str
        What to do. May be empty.
    """

    def __init__(self, message: str, *, place: str = "", fix: str = "") -> None:
        self.message, self.place, self.fix = message, place, fix
        super().__init__(str(self))

    def __str__(self) -> str:
        head = f"{self.place}: {self.message}" if self.place else self.message
        return f"{head}. {self.fix}" if self.fix else head


class BadRecord(IdentifyError):
    """The record cannot be read, or it has values that no measurement gives."""


class BadModel(IdentifyError):
    """A MODEL.json cannot be read, or cannot be used for the request."""


class RunsAway(BadModel):
    """The torque that a model predicts grows without limit."""


class BadRequest(IdentifyError):
    """An unknown method, effect, segment or option."""


class NotIdentifiable(IdentifyError):
    """The record does not determine what is to be estimated."""


class Cancelled(IdentifyError):
    """The caller's progress function asked to stop."""
