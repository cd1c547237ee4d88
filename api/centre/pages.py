"""The centre's pages: the rigs' base with another bar and no stop button; rigs, participants across rigs, warnings."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote, urlencode

from fastapi import APIRouter, Form, Query, Request
from fastapi.responses import RedirectResponse, Response
from jinja2 import ChoiceLoader, FileSystemLoader, PrefixLoader
from sqlalchemy import select
from stimrig.api.centre.check import UNSEEN_S
from stimrig.api.centre.context import Context, Ctx
from stimrig.api.centre.directory import VERDICT_NAMES, asked, page_key
from stimrig.api.centre.ingest import LEAST_DISK_BYTES, LEAST_DISK_SHARE, MOST_CLOCK_S
from stimrig.api.store.centre_tables import CentreEffect, CentreRig

from stimrig.api.centre import directory, warnings
from stimrig.api.charts import trend_charts
from stimrig.api.clock import unix_of
from stimrig.api.effect_words import effect_words
from stimrig.api.errors import ApiError, NotFoundError, forbidden
from stimrig.api.models import changes
from stimrig.api.models.stored_model import followed
from stimrig.api.people.auth import LOCKED, Principal, Scope
from stimrig.api.web.dependencies import Administrator, ModelReader
from stimrig.api.web.guards import identified
from stimrig.api.web.pages.environment import HERE, environment
from stimrig.api.web.pages.home import sign_in_page
from stimrig.api.web.pages.render import Face, page, problem_page

router = APIRouter(include_in_schema=False)
FINE_STATES = ("ready", "calibrating", "arming", "running", "sealing", "stopping")
"""Of `stimrig.rig.messages.RigState`. Any other one, also of a newer rig, is something to look at."""
MOST_EFFECTS = 100
WEB = FileSystemLoader(HERE / "templates")
own = environment.overlay(
    loader=ChoiceLoader([FileSystemLoader(Path(__file__).parent / "templates"), WEB, PrefixLoader({"rig": WEB})])
)
"""The centre's templates first; `rig/…` is the rigs' one of a name that both have."""
environment.filters["warning_title"] = warnings.title
environment.filters["warning_advice"] = warnings.advice


def bar(request: Request, _looking: Principal | None, principal: Principal | None) -> dict[str, Any]:
    """What every page has at its top."""
    waiting = request.app.state.context.waiting_warnings if principal is not None else 0
    return {"right": None, "current": None, "warnings": waiting, "most": warnings.MOST_OPEN}


FACE = Face(own, bar)


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
        return problem_page(request, forbidden("This needs the scope read-model."))
    return await rig_page(request, context)


async def rig_page(request: Request, context: Context, key: dict[str, Any] | None = None) -> Response:
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
    return await rig_page(request, context, {"name": name, "key": key})


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


@router.get("/participants")
async def participants(
    request: Request, context: Ctx, _who: ModelReader, q: str = "", rig: str = "", from_: str = Query("", alias="from"),
    to: str = "", effect: str = "", verdict: str = "", after: str = "",
) -> Response:  # fmt: skip
    """The search and what it finds."""
    given = {"q": q.strip()[:32], "rig": rig, "from": from_, "to": to, "effect": effect, "verdict": verdict}
    problem, found, last = None, [], None
    try:
        search = await asyncio.to_thread(asked, context.store, q, rig, from_, to, effect, verdict, after)
        found, last = await asyncio.to_thread(directory.participants, context.store, search)
    except ApiError as error:
        if error.status not in (404, 422):
            raise
        problem = error
    await context.count_warnings()
    rigs = await asyncio.to_thread(context.rigs.all)
    effects = await asyncio.to_thread(known_effects, context)
    more = urlencode({**given, "after": last}) if last else None
    status = problem.status if problem else 200
    return page(
        request, "participants.html", status, found=found, more=more, given=given, problem=problem, after=after,
        verdicts=VERDICT_NAMES, rigs=[row.name for row in rigs], effects=effects,
    )  # fmt: skip


def known_effects(context: Context) -> list[tuple[str, str]]:
    """Effects that any model holds, with their titles: one step in the index for each."""
    found: list[str] = []
    with context.store.read() as session:
        while len(found) < MOST_EFFECTS:
            after = CentreEffect.effect > (found[-1] if found else "")
            one = session.scalars(
                select(CentreEffect.effect).where(after).order_by(CentreEffect.effect).limit(1)
            ).first()
            if one is None:
                break
            found.append(one)
    return sorted(((effect, effect_words(effect)) for effect in found), key=lambda pair: pair[1])


@router.get("/participants/{code}")
async def participant(request: Request, context: Ctx, _who: ModelReader, code: str, before: str = "") -> Response:
    """Sessions over all rigs, newest first, and the trend of their figures."""
    people = await asyncio.to_thread(directory.person, context.store, code[:40])
    if not people:
        raise NotFoundError("participant", code[:40])
    found, more = await asyncio.to_thread(directory.sessions, context.store, code, page_key(before))
    stood = await asyncio.to_thread(directory.stood, context.store, code)
    await context.count_warnings()
    told = documents(code, stood)
    known = {name for one in told for name, figure in one["figures"].items() if figure["value"] is not None}
    panels = [trend_charts.panel(name, told) for name in trend_charts.order(told) if name in known]
    return page(
        request, "participant.html", code=code, people=people, sessions=found, before=before,
        more=f"{more[0]}~{more[1]}" if more else None, panels=panels, told=trend_charts.sessions_told(told),
        count=sum(one["sessions"] for one in people), recordings=sum(one["recordings"] for one in people),
    )  # fmt: skip


def documents(code: str, stood: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Models of a participant's sessions, oldest first, as the trend's charts take them (`api.charts.trend_charts`)."""
    return [_document(code, **one) for one in stood]


def _document(code: str, session: Any, model: Any, rig: str) -> dict[str, Any]:
    told = model.fit.get("figures") or {}
    figures = {
        name: {**one, "uncertainty": None if (one.get("sd") or 0.0) < 0.0 else changes.uncertainty(name, one)}
        for name, one in told.items()
    }
    found = followed(model.fit)
    figures["follows_percent"] = {**_plain(found.percent, "%"), "where": found.where}
    figures["noise_sd_nm"] = _plain(model.fit.get("noise_sd_nm"), "N·m")
    figures["current_ma"] = _plain(session.current_ma, "mA")
    known = {name: one for name, one in figures.items() if one["value"] is not None or name == "current_ma"}
    here = f"{session.day}~{session.rig_id}"
    return {
        "at_utc": session.at_utc, "model_id": model.id, "approved": session.approved_by is not None,
        "approved_by": session.approved_by, "figures": known, "rig": rig,
        "notes": [], "href": f"/participants/{quote(code)}?before={session.day}~{session.rig_id + 1}#s-{here}",
    }  # fmt: skip


def _plain(value: float | None, unit: str) -> dict[str, Any]:
    return {"value": value, "sd": None, "uncertainty": None, "unit": unit}
