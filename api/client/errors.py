"""Errors of the REST client: one tree, with the title, the detail and the status of the problem (RFC 9457)."""

from __future__ import annotations

from typing import Any


class ServiceError(Exception):
    """Root of the client's errors, with the `request` that failed, `title`, `detail` and `status` of its problem.

    `status` is None if there was no answer. `document` is the whole answer: a problem, or what did not complete.
    """

    def __init__(
        self, request: str, title: str, detail: str = "", status: int | None = None, document: Any = None
    ) -> None:
        super().__init__(": ".join(part for part in (request, title, detail) if part))
        self.request, self.title, self.detail, self.status = request, title, detail, status
        self.document: dict[str, Any] = document or {}

    @property
    def code(self) -> str:
        """Stable id of the problem, e.g. "rig-busy": the last part of its `type`."""
        return str(self.document.get("type", "")).rpartition("/")[2]


class Unreachable(ServiceError):
    """The service did not answer, or not in time."""


class NotCompleted(ServiceError):
    """A test or a job ended without its result; `document` is its last state."""


class Refused(ServiceError):
    """The service answered with a problem. Root of the errors that have a status."""


class Invalid(Refused):
    """400, 413, 422: something in the request cannot be used."""


class Unauthorized(Refused):
    """401: no token, or one that is not valid."""


class Forbidden(Refused):
    """403: the token does not allow this."""


class NotFound(Refused):
    """404, 410: it is not there."""


class Conflict(Refused):
    """409, 412: it is not possible now."""


class TooManyRequests(Refused):
    """429: too many wrong tries; try again later."""


class Unavailable(Refused):
    """5xx: the service or its rig cannot do it."""


BY_STATUS = {400: Invalid, 401: Unauthorized, 403: Forbidden, 404: NotFound, 409: Conflict, 410: NotFound}
BY_STATUS |= {412: Conflict, 413: Invalid, 422: Invalid, 429: TooManyRequests}


def refused(request: str, status: int, problem: Any, text: str = "") -> Refused:
    """Make the error of a problem; `text` stands for an answer that is none, e.g. the page of a proxy."""
    kind = BY_STATUS.get(status, Unavailable if status >= 500 else Refused)
    if isinstance(problem, dict) and "title" in problem:
        return kind(request, str(problem["title"]), str(problem.get("detail") or ""), status, problem)
    return kind(request, f"status {status}", text[:200], status)
