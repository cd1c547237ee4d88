"""The choice before a test: the fixed one, or one that stops itself at a target."""

from __future__ import annotations

from starlette.datastructures import FormData

from api.errors import ApiError
from api.sessions.requests import LEAST_PERCENT, MOST_PERCENT, TargetIn, TestIn
from api.web.pages import typed


def asked(sent: FormData, code: str) -> TestIn:
    """The test that a person asks for; one that stops itself is asked about whether or not its target is in reach.

    Raises
    ------
    ApiError
        422: what was typed is no target.
    """
    if sent.get("plan") != "adaptive":
        return TestIn(participant=code)
    try:
        percent = typed.number(str(sent.get("target") or ""))
    except ValueError as error:
        raise no_target(str(error)) from None
    if not (LEAST_PERCENT <= percent <= MOST_PERCENT):
        raise no_target(f"{percent:g} % is not from {LEAST_PERCENT:g} to {MOST_PERCENT:g} %")
    target = TargetIn(curve_percent=percent, step_percent=percent)
    return TestIn(participant=code, kind="adaptive", target=target, anyway=True)


def no_target(why: str) -> ApiError:
    """422, in one line."""
    return ApiError(422, "invalid-input", "This value cannot be used", f"Target: {why}. Nothing was started.")
