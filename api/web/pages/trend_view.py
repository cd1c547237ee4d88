"""A participant's sessions over time, in pictures and a table; and two to six models or sessions side by side."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from stimrig.api import local_time
from stimrig.api.charts import model_charts, trend_charts
from stimrig.api.charts.drawing import Figures
from stimrig.api.charts.model_charts import MOST
from stimrig.api.errors import ApiError
from stimrig.api.models import changes, stored_model
from stimrig.api.models.trend import Session
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader
from stimrig.api.web.pages.render import page, rows_shown
from stimrig.api.web.routes import trend as rest

router = APIRouter(include_in_schema=False)
COLUMNS = (
    "threshold_us", "plateau_nm", "time_constant_s", "damping", "delay_s", "follows_percent", "noise_sd_nm",
    "charge_uc", "current_ma",
)  # fmt: skip


@router.get("/compare")
async def compare(
    request: Request,
    context: Ctx,
    _who: ModelReader,
    model: Annotated[list[str] | None, Query()] = None,
    reference: str = "",
) -> Response:
    """Models of one participant, the oldest first; differences are to `reference`, or to the oldest."""
    rows = await chosen(context, model)
    participant = rows[0].participant
    sessions = await context.trend.for_models(participant, [row.id for row in rows])
    at = next((number for number, row in enumerate(rows) if row.id == reference), 0)
    sides = await asyncio.gather(*(side(context, rows, number) for number in range(len(rows))))
    names = [local_time.when(row.created_utc) for row in rows]
    return page(
        request,
        "compare.html",
        participant=participant,
        sides=sides,
        reference=at,
        table=comparison(sessions, at),
        doubts=[
            (names[number], changes.doubt_sentences(sessions[at].state(), one.state()))
            for number, one in enumerate(sessions)
            if number != at
        ],
        figures=draw(rows, [one["curves"] for one in sides]),
    )


def draw(rows: Sequence[Model], curves: Sequence[dict[str, Any] | None]) -> Figures:
    """The models' curves over one another."""
    names, asked = [local_time.when(row.created_utc) for row in rows], urlencode([("model", row.id) for row in rows])
    figures = {
        "recruitment": model_charts.compared_recruitment([stored_model.read(row) for row in rows], names),
        "step": model_charts.compared_step(curves, names),
    }
    return Figures(figures, f"/compare/figures/{{}}?{asked}")


async def figures_of(context: Context, rows: Sequence[Model]) -> Figures:
    """The charts of models side by side."""
    sides = await asyncio.gather(*(side(context, [row], 0) for row in rows))
    return draw(rows, [one["curves"] for one in sides])


async def chosen(context: Context, asked: list[str] | None) -> list[Model]:
    """The models, the oldest first; 422 where they are too few, too many, or of different participants."""
    ids = list(dict.fromkeys(asked or []))
    if not 2 <= len(ids) <= MOST:
        detail = f"{len(ids)} are chosen. Go back and choose 2 to {MOST} models of the participant."
        raise ApiError(422, "two-models", "Choose two models or more to compare", detail)
    rows = [await asyncio.to_thread(context.versions.get, model_id) for model_id in ids]
    other = next((row for row in rows if row.participant != rows[0].participant), None)
    if other is not None:
        detail = f"{rows[0].id} is of {rows[0].participant}, {other.id} of {other.participant}."
        raise ApiError(422, "two-participants", "The models are of different participants", detail)
    return sorted(rows, key=lambda row: row.created_utc)


async def side(context: Context, rows: Sequence[Model], number: int) -> dict[str, Any]:
    """One model; of two, also its error on the other one's recording."""
    row = rows[number]
    found: dict[str, Any] = {
        "model": await asyncio.to_thread(context.versions.document, row),
        "style": model_charts.style(number),
        "curves": None,
        "elsewhere": None,
        "problem": None,
    }
    try:
        found["curves"] = await context.analyses.curves(row)
        if len(rows) == 2 and rows[0].recording_id != rows[1].recording_id:
            found["elsewhere"] = await context.analyses.comparison(row, rows[1 - number].recording_id)
    except ApiError as error:
        found["problem"] = error
    return found


def comparison(sessions: Sequence[Session], reference: int) -> list[dict[str, Any]]:
    """The figures, a row each: the value of every model, and how far it is from the reference's."""
    documents = [one.page_document()["figures"] for one in sessions]
    known = dict.fromkeys(name for figures in documents for name in figures)
    order = [*(name for name in changes.NAMES if name in known), *(name for name in known if "." in name)]
    return [compared(name, sessions, documents, reference) for name in order]


def compared(
    figure: str, sessions: Sequence[Session], documents: Sequence[dict[str, Any]], reference: int
) -> dict[str, Any]:
    """One figure of all models."""
    unit = next(figures[figure]["unit"] for figures in documents if figure in figures)
    name = changes.name_of(figure, unit)
    cells = []
    for number, figures in enumerate(documents):
        one = figures.get(figure) or {"value": None, "uncertainty": None}
        words = changes.uncertain_words(one["value"], one["uncertainty"], name)
        cell: dict[str, Any] = {"words": words, "where": one.get("where", ""), "difference": None, "beyond": False}
        if number != reference:
            cell |= apart(figure, sessions[reference], sessions[number], name)
        cells.append(cell)
    return {"name": name.words, "unit": "" if name.unit == "1" else name.unit, "cells": cells}


def apart(figure: str, before: Session, now: Session, name: changes.Name) -> dict[str, Any]:
    """A difference in words, and whether it is beyond twice its uncertainty."""
    old, new = before.state(), now.state()
    found = changes.difference(figure, old, new) if figure in changes.comparable(old, new) else None
    if found is None:
        return {"difference": None, "beyond": False}
    words = changes.uncertain_words(found["difference"], found["uncertainty"], name, sign=True)
    return {"difference": words, "beyond": found["beyond"]}


@router.get("/participants/{code}/trend")
async def trend(request: Request, context: Ctx, _who: ModelReader, code: str) -> Response:
    """All sessions in one picture."""
    found = await rest.sessions(context, code)
    documents = [one.page_document() for one in found]
    return page(
        request,
        "trend.html",
        participant=code,
        sessions=[row(one) for one in documents[::-1][: rows_shown(request)]],
        more=len(documents) > (rows_shown(request) or len(documents)),
        panels=trend_charts.panels(documents),
        told=trend_charts.session_rows(documents),
        changes=rest.newest(found),
        columns=[(name.words, "" if name.unit == "1" else name.unit) for name in map(changes.name_of, COLUMNS)],
        most=MOST,
    )


def row(session: dict[str, Any]) -> dict[str, Any]:
    """A session in the table."""
    names = [(figure, changes.name_of(figure)) for figure in COLUMNS]
    cells = [cell(session["figures"][figure], name) for figure, name in names if figure in session["figures"]]
    return {**session, "cells": cells}


def cell(figure: dict[str, Any], name: changes.Name) -> dict[str, Any]:
    """A figure with its 95 % band; `where`: on which pulses it was found, where that is not always the same."""
    words, _sign, band = changes.uncertain_words(figure["value"], figure["uncertainty"], name).partition(" ± ")
    return {"name": name.words, "words": words, "band": band, "where": figure.get("where", "")}


async def changes_of(context: Context, model: Model) -> dict[str, Any] | None:
    """What changed from the last approved session to this model (`changes.html`); None: there is no such session."""
    pair = await context.trend.against(model)
    return rest.between(*pair) if pair else None
