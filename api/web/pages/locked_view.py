"""The page of a locked session: the password again, and back to the page that was open."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.people.auth import Principal
from api.web.browser_session import local
from api.web.dependencies import Anyone, Ctx, EvenLocked
from api.web.pages.render import page

router = APIRouter(include_in_schema=False)


@router.get("/locked")
async def locked(request: Request, who: EvenLocked, next: str = "/") -> Response:
    """The page; straight on where nothing is locked."""
    return shown(request, who, next) if who.locked else RedirectResponse(local(next), 303)


def shown(request: Request, who: Principal, next: str, problem: ApiError | None = None) -> Response:
    """The page, with what went wrong, if anything did."""
    status = problem.status if problem else 200
    answer = page(request, "locked.html", status, waiting=who, next=local(next), problem=problem)
    answer.headers.update(problem.headers if problem else {})
    return answer


@router.post("/unlock")
async def unlock(
    request: Request, context: Ctx, who: EvenLocked, secret: Annotated[str, Form()] = "",
    next: Annotated[str, Form()] = "/",
) -> Response:  # fmt: skip
    """Go on, by the password of who is signed in, or by the token that opened the session."""
    try:
        await context.people.unlock(who, secret[:200].strip() if who.session_hash is None else secret[:200])
    except ApiError as error:
        return shown(request, who, next, error)
    return RedirectResponse(local(next), 303)


@router.post("/lock")
async def lock(context: Ctx, who: Anyone, next: Annotated[str, Form()] = "/") -> Response:
    """Lock it now."""
    if who.page_session is not None:
        await asyncio.to_thread(context.auth.idle.lock, who.page_session.hash, who.name)
    return RedirectResponse(local(next), 303)
