"""The door: signing in and out, and the first page."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.auth import COOKIE
from api.context import Anyone, Context, Ctx
from api.errors import ApiError
from api.pages.render import page
from api.store.tables import Participant, Test

router = APIRouter(include_in_schema=False)


@router.get("/")
async def home(request: Request, context: Ctx) -> Response:
    """Participants and the rig; the sign-in form for who is not signed in."""
    try:
        context.auth.identify(request)
    except ApiError:
        return page(request, "sign_in.html", next="/", problem=None)
    rows = await asyncio.to_thread(_overview, context)
    return page(request, "home.html", rows=rows)


def _overview(context: Context) -> list[dict[str, Any]]:
    rows = []
    for participant in context.store.all(Participant, order=Participant.code):
        tests = context.store.all(Test, Test.participant == participant.code, order=Test.requested_utc.desc(), limit=1)
        models = context.versions.of(participant.code)
        rows.append(
            {
                "code": participant.code,
                "last": tests[0] if tests else None,
                "newest": context.versions.public(models[0]) if models else None,
                "approved": context.versions.approved(participant.code),
            }
        )
    return rows


@router.get("/sign-in")
def sign_in_form(request: Request, next: str = "/") -> Response:
    """The form."""
    return page(request, "sign_in.html", next=local(next), problem=None)


@router.post("/sign-in")
async def sign_in(
    request: Request, context: Ctx, token: Annotated[str, Form()] = "", next: Annotated[str, Form()] = "/"
) -> Response:
    """Open a session with a token."""
    try:
        cookie = await asyncio.to_thread(context.auth.sign_in, token.strip())
    except ApiError as error:
        return page(request, "sign_in.html", 401, next=local(next), problem=error)
    response = RedirectResponse(local(next), 303)
    response.set_cookie(
        COOKIE,
        cookie,
        max_age=int(context.auth.session_s),
        httponly=True,
        samesite="strict",
        secure=context.settings.secure_cookies,
    )
    return response


@router.post("/sign-out")
async def sign_out(request: Request, context: Ctx, _who: Anyone) -> Response:
    """End the session."""
    await asyncio.to_thread(context.auth.sign_out, request.cookies.get(COOKIE, ""))
    response = RedirectResponse("/", 303)
    response.delete_cookie(COOKIE)
    return response


def local(target: str) -> str:
    """An address on this host, or the first page."""
    plain = target.startswith("/") and not target.startswith(("//", "/\\"))
    return target if plain else "/"
