"""Participants across rigs: a search, and each one's page with sessions and trends."""

from __future__ import annotations

import asyncio
from typing import Any
from urllib.parse import quote, urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response
from sqlalchemy import select

from stimrig.api.centre import directory
from stimrig.api.centre.context import Context, Ctx
from stimrig.api.centre.routes.participants import VERDICT_NAMES, asked, page_key
from stimrig.api.charts import trend_charts
from stimrig.api.effect_words import effect_words
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.models import changes
from stimrig.api.models.summary import followed
from stimrig.api.store.centre_tables import CentreEffect
from stimrig.api.web.dependencies import ModelReader
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)
MOST_EFFECTS = 100


@router.get("/participants")
async def participants(
    request: Request, context: Ctx, _who: ModelReader, q: str = "", rig: str = "", from_: str = Query("", alias="from"),
    to: str = "", effect: str = "", verdict: str = "", after: str = "",
) -> Response:  # fmt: skip
    """The search and what it finds."""
    given = {"q": q.strip()[:32], "rig": rig, "from": from_, "to": to, "effect": effect, "verdict": verdict}
    problem, found, last = None, [], None
    try:
        search = await asyncio.to_thread(asked, context, q, rig, from_, to, effect, verdict, after)
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
        more=f"{more[0]}~{more[1]}" if more else None, panels=panels,
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
