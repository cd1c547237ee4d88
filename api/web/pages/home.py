"""Signing in and out, a session that is locked, and the first page, where participants are made."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.errors import ApiError
from stimrig.api.people.auth import LOCKED, Principal, Scope
from stimrig.api.services import participants
from stimrig.api.sessions.requests import ParticipantIn
from stimrig.api.web.dependencies import Anyone, Context, Ctx, EvenLocked, Tester
from stimrig.api.web.guards import identified, local, same_origin, set_cookie
from stimrig.api.web.pages import typed
from stimrig.api.web.pages.render import look, page, problem_page
from stimrig.api.web.pages.typed import Text

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
    found = participants.matching(context.store, asked.q, asked.archived)
    shown = [row for row, _last_utc in (found if asked.all else found[:SHOWN])]
    count = participants.participant_counts(context.store)
    rows = participants.list_rows(context.store, context.versions, shown)
    return {"rows": rows, "more": len(found) - len(rows), "count": count}


@router.post("/participants")
async def create_participant(
    context: Ctx, who: Tester, code: Text = "", side: Text = "",
    muscle: Text = "", placement: Text = "",
) -> Response:  # fmt: skip
    """A new participant."""
    said = {"side": side or None, "muscle": muscle.strip() or None, "placement": placement.strip() or None}
    body = typed.checked(ParticipantIn, code=code.strip(), **said)
    row = await asyncio.to_thread(participants.create, context, body, who.name)
    return RedirectResponse(f"/participants/{row.code}", 303)


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
    name: Text = "", password: Text = "", token: Text = "",
    next: Text = "/",
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


@router.get("/locked")
async def locked(request: Request, who: EvenLocked, next: str = "/") -> Response:
    """The page of a locked session; straight on where nothing is locked."""
    return locked_page(request, who, next) if who.locked else RedirectResponse(local(next), 303)


def locked_page(request: Request, who: Principal, next: str, problem: ApiError | None = None) -> Response:
    """The password again, and back to the page that was open; with what went wrong, if anything did."""
    status = problem.status if problem else 200
    answer = page(request, "locked.html", status, waiting=who, next=local(next), problem=problem)
    answer.headers.update(problem.headers if problem else {})
    return answer


@router.post("/unlock")
async def unlock(
    request: Request, context: Ctx, who: EvenLocked, secret: Text = "",
    next: Text = "/",
) -> Response:  # fmt: skip
    """Go on, by the password of who is signed in, or by the token that opened the session."""
    try:
        await context.people.unlock(who, secret[:200].strip() if who.session_hash is None else secret[:200])
    except ApiError as error:
        return locked_page(request, who, next, error)
    return RedirectResponse(local(next), 303)


@router.post("/lock")
async def lock(context: Ctx, who: Anyone, next: Text = "/") -> Response:
    """Lock it now."""
    if who.page_session is not None:
        await asyncio.to_thread(context.auth.idle.lock, who.page_session.hash, who.name)
    return RedirectResponse(local(next), 303)
