"""The first page, with the participants; signing in."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Scope
from stimrig.api.services import participants
from stimrig.api.web.dependencies import Context, Ctx
from stimrig.api.web.guards import identified, local
from stimrig.api.web.pages.render import identify_viewer, page

router = APIRouter(include_in_schema=False)
FIRST_ROWS = 50
"""Participants listed on the first page before *all* is chosen."""


@router.get("/")
async def home(request: Request, context: Ctx, q: str = "", all: str = "") -> Response:
    """Show participants and the rig; the sign-in form to who is not signed in."""
    try:
        principal = await identified(request)
    except ApiError:
        return await sign_in(request, context)
    q, listed = q[:80].strip(), None
    if principal.may(Scope.RUN_TEST):
        listed = await asyncio.to_thread(list_participants, context, q, None if all == "1" else FIRST_ROWS)
    return page(request, "home.html", q=q, listed=listed)


def list_participants(context: Context, q: str, limit: int | None) -> dict[str, Any]:
    """Return the rows of the list, and how many more match."""
    matching = participants.matching(context.store, q)
    rows = participants.list_rows(context.store, context.versions, matching[:limit])
    return {"rows": rows, "more": len(matching) - len(rows)}


@router.get("/sign-in")
async def sign_in(request: Request, context: Ctx, next: str = "/") -> Response:
    """Show the sign-in form."""
    people = await asyncio.to_thread(context.people.any)
    await identify_viewer(request)
    return page(request, "sign_in.html", next=local(next), people=people)
