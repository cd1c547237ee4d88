"""The service's errors: each is a problem that a client can be shown as it is (RFC 9457)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from stimrig.rig.messages import Problem as RigProblem

T = TypeVar("T")
RIG_STATUS = {"refused": 422, "rest-needed": 422, "bad-plan": 422, "disconnected": 503, "internal": 502}
"""HTTP status of each of the rig's refusals; every other one is answered by 409."""


class ApiError(Exception):
    """Root of the service's errors: a problem that can be shown to the client as it is.

    `status`: of HTTP; `code`: stable id, the last part of the problem's ``type``; `title`, `detail`: what is wrong, and
    where, and the fix; `extra`: more members of the problem, as ``holder`` or ``errors``.
    """

    def __init__(self, status: int, code: str, title: str, detail: str = "", **extra: Any) -> None:
        super().__init__(f"{title}: {detail}" if detail else title)
        self.status, self.code, self.title, self.detail, self.extra = status, code, title, detail, extra
        self.headers: dict[str, str] = {}

    def body(self, instance: str | None = None) -> dict[str, Any]:
        """The problem's JSON object (RFC 9457, section 3.1)."""
        core = {"type": f"/problems/{self.code}", "title": self.title, "status": self.status, "detail": self.detail}
        return {**core, **({"instance": instance} if instance else {}), **self.extra}


class NotFoundError(ApiError):
    """The requested item does not exist."""

    def __init__(self, what: str, name: str, fix: str = "") -> None:
        super().__init__(404, "not-found", f"No such {what}", f"There is no {what} {name!r}. {fix}".strip())


def require_found(item: T | None, what: str, name: str, fix: str = "") -> T:
    """Return the item. Raises NotFoundError: it is None."""
    if item is None:
        raise NotFoundError(what, name, fix)
    return item


def invalid(detail: str, **extra: Any) -> ApiError:
    """422: something in the request does not hold."""
    return ApiError(422, "invalid-input", "The request is not valid", detail, **extra)


def forbidden(detail: str) -> ApiError:
    """403: it is known who asks, and they may not."""
    return ApiError(403, "forbidden", "Not allowed", detail)


def not_answering() -> ApiError:
    """503: the database is unavailable, or locked for too long."""
    return ApiError(503, "database", "The database does not answer", "Nothing was changed. Try again in a minute.")


class SettingsError(Exception):
    """A setting does not hold: one line, by the name of its environment variable."""


def from_rig(problem: RigProblem, **extra: Any) -> ApiError:
    """Return the rig's refusal as an API problem."""
    status = RIG_STATUS.get(problem.code, 409)
    return ApiError(status, f"rig-{problem.code}", problem.title, problem.detail, **extra)
