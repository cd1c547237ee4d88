"""The first page: rigs; adding one, revoking its key. And what a person has to know of."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.centre import warnings
from stimrig.api.centre.check import UNSEEN_S
from stimrig.api.centre.context import Context, Ctx
from stimrig.api.centre.ingest import LEAST_DISK_BYTES, LEAST_DISK_SHARE, MOST_CLOCK_S
from stimrig.api.clock import unix_of
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import LOCKED, Scope
from stimrig.api.store.centre_tables import CentreRig
from stimrig.api.web.dependencies import Administrator, ModelReader
from stimrig.api.web.guards import identified
from stimrig.api.web.pages.home import sign_in_page
from stimrig.api.web.pages.render import page, problem_page

router = APIRouter(include_in_schema=False)
FINE_STATES = ("ready", "calibrating", "arming", "running", "sealing", "stopping")
"""Of `stimrig.rig.messages.RigState`. Any other one, also of a newer rig, is something to look at."""


@router.get("/")
async def rigs(request: Request, context: Ctx) -> Response:
    """Rigs; the sign-in form for who is not signed in."""
    try:
        who = await identified(request)
    except ApiError as error:
        if error.code == LOCKED[0]:
            return problem_page(request, error)
        return await sign_in_page(request, context, "/")  # pyright: ignore[reportArgumentType]
    if not who.may(Scope.READ_MODEL):
        return problem_page(request, ApiError(403, "forbidden", "Not allowed", "This needs the scope read-model."))
    return await shown(request, context)


async def shown(request: Request, context: Context, key: dict[str, Any] | None = None) -> Response:
    """The page; with a key that was just made, the only time its text is seen."""
    rows = await asyncio.to_thread(context.rigs.all)
    await context.count_warnings()
    now_s = context.clock.unix_s()
    listed = [{**row.as_dict(), "doubts": doubts(row, now_s)} for row in rows if row.revoked_utc is None]
    revoked = [row for row in rows if row.revoked_utc is not None]
    address = str(request.base_url).rstrip("/")
    return page(request, "rigs.html", rigs=listed, revoked=revoked, key=key, address=address)


def doubts(row: CentreRig, now_s: float) -> set[str]:
    """What of a rig a person should look at."""
    free, total = row.disk_free_bytes, row.disk_total_bytes
    found = {
        "seen": row.seen_utc is not None and now_s - unix_of(row.seen_utc) > UNSEEN_S,
        "clock": row.seen_utc is not None and not abs(row.clock_difference_s or 0.0) <= MOST_CLOCK_S,
        "disk": free is not None and total is not None and free < min(LEAST_DISK_SHARE * total, LEAST_DISK_BYTES),
        "state": row.state is not None and row.state not in FINE_STATES,
    }
    return {name for name, so in found.items() if so}


@router.post("/rigs")
async def add(request: Request, context: Ctx, who: Administrator, name: Annotated[str, Form()] = "") -> Response:
    """A new rig; its key is shown on the answering page only."""
    name = name.strip()[:80]
    key = await asyncio.to_thread(context.rigs.add, name, who.name)
    return await shown(request, context, {"name": name, "key": key})


@router.post("/rigs/{name}/revoke")
async def revoke(context: Ctx, who: Administrator, name: str) -> Response:
    """Its key opens nothing any more."""
    await asyncio.to_thread(context.rigs.revoke, name, who.name)
    return RedirectResponse("/", 303)


@router.get("/warnings")
async def list_warnings(request: Request, context: Ctx, _who: ModelReader) -> Response:
    """Those that wait, and the last ones that somebody has acknowledged."""
    waiting = await asyncio.to_thread(warnings.listed, context.store)
    await context.count_warnings()
    seen = await asyncio.to_thread(warnings.listed, context.store, True)
    return page(request, "warnings.html", waiting=waiting, seen=seen[:50])


@router.post("/warnings/{warning_id}/acknowledge")
async def acknowledge(context: Ctx, who: Administrator, warning_id: int) -> Response:
    """A person has seen it."""
    await asyncio.to_thread(warnings.acknowledge, context.store, context.clock, warning_id, who.name)
    return RedirectResponse("/warnings", 303)
