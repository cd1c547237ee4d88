"""Which electrode of an array, on one screen: the map, the next stimulus, what it gave, the choice."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable
from typing import Any

from fastapi import APIRouter, Request, Response

from stimrig.api.charts.electrode_map import array_map, named
from stimrig.api.errors import ApiError, require_found
from stimrig.api.sessions import channels, electrodes
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import typed
from stimrig.api.web.pages.render import done_or_said, page
from stimrig.api.web.routes import electrodes as searches
from stimrig.api.web.routes import participants

router = APIRouter(include_in_schema=False, prefix="/participants/{code}/electrodes")
COUNTS, FIELDS = ("rows", "columns"), ("width_us", "current_ma", "rows", "columns", "pitch_mm")
SHOWN = 12
"""Rows of the table: what was stimulated, and the best of the others."""


@router.get("")
async def show(request: Request, context: Ctx, _who: Tester, code: str, anew: str = "") -> Response:
    """The newest search as it stands; the form that begins one where there is none, or with `anew`."""
    return await show_page(request, context, code, anew=bool(anew))


async def show_page(
    request: Request, context: Context, code: str, problem: ApiError | None = None, anew: bool = False,
    texts: dict[str, str] | None = None, errors: dict[str, str] | None = None,
) -> Response:  # fmt: skip
    """The page, with what just went wrong."""
    person = await asyncio.to_thread(participants.find, context, code)
    array = electrodes.array_of(context.rig.status)
    former = await asyncio.to_thread(searches.searches_of, context, code) if array else []
    row = next((one for one in former if array and one.channel == array.channel), None)
    found = await searches.standing(context, row) if row and not anew else None
    own = channels.held(person, array.key)["profile"] if array else {}
    usual = {"width_us": own.get("max_pulse_width_us"), "current_ma": own.get("current_ma"), "pitch_mm": 12.0}
    kept = {name: typed.number_text(value) for name, value in {**usual, **(row.asked if row else {})}.items()
            if name in FIELDS and value is not None}  # fmt: skip
    status = problem.status if problem else 422 if errors else 200
    return page(
        request, "electrodes.html", status, participant=person, array=array, found=found, problem=problem, row=row,
        texts=texts or kept, errors=errors or {}, wishes=electrodes.WISHES, named=named, rows=ranked(found),
        picture=array_map(found, "Map of the array") if found else "",
        voids=array is not None and searches.loses_calibration(person, array.key, ""),
    )  # fmt: skip


def ranked(found: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The choices that the table has, best first."""
    every = sorted((found or {"map": []})["map"], key=lambda one: (not one["stimulated"], -one["utility"]["mean"]))
    return sorted(every[:SHOWN], key=lambda one: -one["utility"]["mean"])


async def attempt(request: Request, context: Context, code: str, done: Awaitable[Any]) -> Response:
    """Do it and show the page; what is refused is said there."""
    leads = f"/participants/{code}/electrodes"
    return await done_or_said(done, lambda problem: show_page(request, context, code, problem), leads)


@router.post("")
async def begin(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """Begin a search with what was typed."""
    sent = await request.form()
    texts = {name: str(sent[name])[:60] for name in FIELDS if name in sent}
    values, errors = typed.numbers(texts)
    if errors:
        return await show_page(request, context, code, anew=True, texts=texts, errors=errors)
    given: dict[str, Any] = {name: int(value) if name in COUNTS else value for name, value in values.items()}
    given |= {name: str(sent[name]) for name in ("wish", "direction") if name in sent}
    body = typed.checked(searches.SearchIn, **given)
    return await attempt(request, context, code, searches.begin_search(context, who, code, body, Response()))


@router.post("/{search_id}/stimuli")
async def play(request: Request, context: Ctx, who: Tester, code: str, search_id: str) -> Response:
    """Play the elements of the button, or those that were typed."""
    sent = await request.form()

    async def done() -> None:
        body = typed.checked(searches.PlayIn, elements=_elements(sent))
        await searches.play_stimulus(context, who, await own(context, code, search_id), body)

    return await attempt(request, context, code, done())


@router.post("/{search_id}/seen")
async def tell(request: Request, context: Ctx, who: Tester, code: str, search_id: str) -> Response:
    """Keep what was seen."""
    sent = await request.form()

    async def done() -> None:
        if not (sent.get("spill") and sent.get("comfort")):
            raise typed.unusable("Say both: how far it spilled over, and how it felt.")
        comfort = typed.wanted(str(sent["comfort"]), lambda why: f"comfort: {why}")
        given = {"test_id": str(sent.get("test_id")), "spill": sent["spill"], "comfort": comfort}
        await searches.tell_seen(
            context, who, await own(context, code, search_id), typed.checked(searches.SeenIn, **given)
        )

    return await attempt(request, context, code, done())


@router.post("/{search_id}/choice")
async def choose(request: Request, context: Ctx, who: Tester, code: str, search_id: str) -> Response:
    """Use these elements from now on; `voids`: the form said that a calibration at another place ends with it."""
    sent = await request.form()

    async def done() -> None:
        given = {"elements": _elements(sent), "void_calibration": "voids" in sent}
        await searches.choose(
            context, who, await own(context, code, search_id), typed.checked(searches.ChoiceIn, **given)
        )

    return await attempt(request, context, code, done())


async def own(context: Context, code: str, search_id: str) -> str:
    """The search's id. Raises NotFoundError (404): it is another participant's."""
    row = await asyncio.to_thread(searches.find, context, search_id)
    return require_found(search_id if row.participant == code else None, "search", search_id, searches.LISTED)


def _elements(sent: Any) -> list[int]:
    """Elements as a button has them, or as they were typed: 5, or 5+6."""
    found = re.findall(r"\d{1,3}", str(sent.get("elements") or sent.get("typed") or ""))
    if not 1 <= len(found) <= 2:
        raise typed.unusable("Type one element or a pair, like 5 or 5+6.")
    return [int(number) for number in found]
