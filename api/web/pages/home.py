"""The door: signing in and out, and the first page."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.people.auth import COOKIE, Scope
from api.store.tables import Participant, Test
from api.web.browser_session import local, same_origin, set_cookie
from api.web.dependencies import Anyone, Context, Ctx
from api.web.pages.render import page

router = APIRouter(include_in_schema=False)


@router.get("/")
async def home(request: Request, context: Ctx) -> Response:
    """Participants and the rig; the sign-in form for who is not signed in."""
    try:
        who = context.auth.identify(request)
    except ApiError:
        return await door(request, context, "/")
    may_test = who.may(Scope.RUN_TEST)
    rows = await asyncio.to_thread(_overview, context) if may_test else []
    return page(request, "home.html", rows=rows, may_test=may_test)


async def door(
    request: Request, context: Context, next: str, problem: ApiError | None = None, name: str = ""
) -> Response:
    """The sign-in form; with what went wrong, if anything did."""
    people = await asyncio.to_thread(context.people.any)
    status = problem.status if problem else 200
    answer = page(request, "sign_in.html", status, next=local(next), problem=problem, people=people, name=name)
    answer.headers.update(problem.headers if problem else {})
    return answer


def _overview(context: Context) -> list[dict[str, Any]]:
    rows = []
    for participant in context.store.all(Participant, order=Participant.code):
        tests = context.store.all(Test, Test.participant == participant.code, order=Test.requested_utc.desc(), limit=1)
        models = context.versions.of(participant.code)
        rows.append(
            {
                "code": participant.code,
                "last": tests[0] if tests else None,
                "newest": context.versions.document(models[0]) if models else None,
                "approved": context.versions.approved(participant.code),
            }
        )
    return rows


@router.get("/sign-in")
async def sign_in_form(request: Request, context: Ctx, next: str = "/") -> Response:
    """The form."""
    return await door(request, context, next)


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
            cookie = await context.people.sign_in(name.strip()[:80], password[:200], address)
    except ApiError as error:
        return await door(request, context, next, error, name[:80])
    response = RedirectResponse(local(next), 303)
    set_cookie(context, response, cookie)
    return response


@router.post("/sign-out")
async def sign_out(request: Request, context: Ctx, _who: Anyone) -> Response:
    """End the session."""
    await asyncio.to_thread(context.auth.sign_out, request.cookies.get(COOKIE, ""))
    response = RedirectResponse("/", 303)
    response.delete_cookie(COOKIE)
    return response
