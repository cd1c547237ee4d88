"""Signing in and out, and the first page."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.people.auth import LOCKED, Scope
from api.sessions import directory
from api.web.browser_session import local, same_origin, set_cookie
from api.web.dependencies import Context, Ctx, EvenLocked
from api.web.guards import identified
from api.web.pages.render import look, page, problem_page

router = APIRouter(include_in_schema=False)
SHOWN = 50
"""So many participants are on the first page; a search, or one click, finds the others."""


@router.get("/")
async def home(request: Request, context: Ctx, q: str = "", archived: str = "", all: str = "") -> Response:
    """Participants and the rig; the sign-in form for who is not signed in."""
    try:
        who = await identified(request)
    except ApiError as error:
        return await sign_in_page(request, context, "/") if error.code != LOCKED[0] else problem_page(request, error)
    asked = Asked(q[:80].strip(), archived == "1", all == "1")
    listed = await asyncio.to_thread(_list, context, asked) if who.may(Scope.RUN_TEST) else None
    return page(request, "home.html", asked=asked, listed=listed)


@dataclass(frozen=True)
class Asked:
    """What the list is asked for: a part of the code, the archive, all of them."""

    q: str = ""
    archived: bool = False
    all: bool = False


def _list(context: Context, asked: Asked) -> dict[str, Any]:
    found = directory.found(context.store, asked.q, asked.archived)
    shown = [row for row, _last_utc in (found if asked.all else found[:SHOWN])]
    count = directory.counts(context.store)
    rows = directory.listed(context.store, context.versions, shown)
    return {"rows": rows, "more": len(found) - len(rows), "count": count}


async def sign_in_page(
    request: Request, context: Context, next: str, problem: ApiError | None = None, name: str = ""
) -> Response:
    """The sign-in form; with what went wrong, if anything did."""
    people = await asyncio.to_thread(context.people.any)
    status = problem.status if problem else 200
    await look(request)
    answer = page(request, "sign_in.html", status, next=local(next), problem=problem, people=people, name=name)
    answer.headers.update(problem.headers if problem else {})
    return answer


@router.get("/sign-in")
async def sign_in_form(request: Request, context: Ctx, next: str = "/") -> Response:
    """The form."""
    return await sign_in_page(request, context, next)


@router.post("/sign-in")
async def sign_in(
    request: Request, context: Ctx,
    name: Annotated[str, Form()] = "", password: Annotated[str, Form()] = "", token: Annotated[str, Form()] = "",
    next: Annotated[str, Form()] = "/",
) -> Response:  # fmt: skip
    """Open a session with name and password, or with a token."""
    address = request.client.host if request.client else ""
    try:
        same_origin(request)
        if token.strip():
            cookie = await asyncio.to_thread(context.auth.sign_in, token.strip(), address)
        else:
            cookie = await context.people.sign_in(name.strip()[:320], password[:200], address)
    except ApiError as error:
        return await sign_in_page(request, context, next, error, name[:80])
    response = RedirectResponse(local(next), 303)
    set_cookie(context, response, cookie)
    return response


@router.post("/sign-out")
async def sign_out(request: Request, context: Ctx, _who: EvenLocked) -> Response:
    """End the session."""
    await asyncio.to_thread(context.auth.sign_out, request.cookies.get(context.auth.cookie_name, ""))
    response = RedirectResponse("/", 303)
    response.delete_cookie(context.auth.cookie_name)
    return response
