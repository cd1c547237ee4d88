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
from stimrig.api.charts.model_charts import MAX_COMPARED
from stimrig.api.errors import ApiError
from stimrig.api.models import changes, stored_model
from stimrig.api.models.trend import Session, newest_changes
from stimrig.api.services import participants
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader
from stimrig.api.web.pages.render import page, rows_shown

router = APIRouter(include_in_schema=False)
COLUMNS = (
    "threshold_us", "plateau_nm", "time_constant_s", "damping", "delay_s", "follows_percent", "noise_sd_nm",
    "charge_uc", "current_ma",
)  # fmt: skip


@router.get("/participants/{code}/trend")
def trend(request: Request, context: Ctx, _principal: ModelReader, code: str) -> Response:
    """Show all sessions in one picture."""
    participants.find(context, code)
    sessions = context.trend.sessions(code)
    documents = [session.page_document() for session in sessions]
    rows = documents[::-1][: rows_shown(request)]
    return page(
        request,
        "trend.html",
        participant=code,
        sessions=[{**session, "cells": _session_cells(session)} for session in rows],
        more=len(documents) > len(rows),
        panels=trend_charts.panels(documents),
        session_rows=trend_charts.session_rows(documents),
        changes=newest_changes(sessions),
        columns=[(name.words, "" if name.unit == "1" else name.unit) for name in map(changes.name_of, COLUMNS)],
        most=MAX_COMPARED,
    )


def _session_cells(session: dict[str, Any]) -> list[dict[str, Any]]:
    """Return figures with their 95 % band; `where`: on which pulses one was found, if that is not always the same."""
    cells = []
    for key, name in zip(COLUMNS, map(changes.name_of, COLUMNS), strict=True):
        if (figure := session["figures"].get(key)) is not None:
            words, _sign, band = changes.uncertain_words(figure["value"], figure["uncertainty"], name).partition(" ± ")
            cells.append({"name": name.words, "words": words, "band": band, "where": figure.get("where", "")})
    return cells


@router.get("/compare")
async def compare(
    request: Request,
    context: Ctx,
    _principal: ModelReader,
    model: Annotated[list[str] | None, Query()] = None,
    reference: str = "",
) -> Response:
    """Show models of one participant, the oldest first; differences are to `reference`, or to the oldest."""
    rows = await chosen(context, model)
    participant = rows[0].participant
    sessions = await asyncio.to_thread(context.trend.for_models, participant, [row.id for row in rows])
    number = next((number for number, row in enumerate(rows) if row.id == reference), 0)
    sides = await asyncio.gather(*(_side(context, rows, number) for number in range(len(rows))))
    doubt_rows = [(local_time.when(row.created_utc), changes.doubt_sentences(sessions[number].state(), session.state()))
              for row, session in zip(rows, sessions, strict=True) if session is not sessions[number]]  # fmt: skip
    return page(
        request,
        "compare.html",
        participant=participant,
        sides=sides,
        reference=number,
        table=comparison(sessions, number),
        doubts=doubt_rows,
        figures=_draw(rows, [side["curves"] for side in sides]),
    )


async def chosen(context: Context, model_ids: list[str] | None) -> list[Model]:
    """Return the models, the oldest first; 422 if they are too few, too many, or of different participants."""
    ids = list(dict.fromkeys(model_ids or []))
    if not 2 <= len(ids) <= MAX_COMPARED:
        detail = f"{len(ids)} are chosen. Go back and choose 2 to {MAX_COMPARED} models of the participant."
        raise ApiError(422, "two-models", "Choose two models or more to compare", detail)
    rows = [await asyncio.to_thread(context.versions.get, model_id) for model_id in ids]
    other = next((row for row in rows if row.participant != rows[0].participant), None)
    if other is not None:
        detail = f"{rows[0].id} is of {rows[0].participant}, {other.id} of {other.participant}."
        raise ApiError(422, "two-participants", "The models are of different participants", detail)
    return sorted(rows, key=lambda row: row.created_utc)


async def figures_of(context: Context, rows: Sequence[Model]) -> Figures:
    """Return the charts of models side by side."""
    sides = await asyncio.gather(*(_side(context, [row], 0) for row in rows))
    return _draw(rows, [side["curves"] for side in sides])


def _draw(rows: Sequence[Model], curves: Sequence[dict[str, Any] | None]) -> Figures:
    names, query = [local_time.when(row.created_utc) for row in rows], urlencode([("model", row.id) for row in rows])
    figures = {
        "recruitment": model_charts.compared_recruitment([stored_model.read(row) for row in rows], names),
        "step": model_charts.compared_step(curves, names),
    }
    return Figures(figures, f"/compare/figures/{{}}?{query}")


async def _side(context: Context, rows: Sequence[Model], number: int) -> dict[str, Any]:
    """Return one model; of two, also its error on the other one's recording."""
    row = rows[number]
    side: dict[str, Any] = {
        "model": await asyncio.to_thread(context.versions.document, row), "style": model_charts.style(number),
        "curves": None, "elsewhere": None, "problem": None,
    }  # fmt: skip
    try:
        side["curves"] = await context.analyses.curves(row)
        if len(rows) == 2 and rows[0].recording_id != rows[1].recording_id:
            side["elsewhere"] = await context.analyses.comparison(row, rows[1 - number].recording_id)
    except ApiError as error:
        side["problem"] = error
    return side


def comparison(sessions: Sequence[Session], reference: int) -> list[dict[str, Any]]:
    """Return a row for each figure: the value of every model, and how far it is from the reference's."""
    documents = [session.page_document()["figures"] for session in sessions]
    units = {key: figure["unit"] for figures in documents for key, figure in figures.items()}
    table = []
    for key in (*(key for key in changes.NAMES if key in units), *(key for key in units if "." in key)):
        name, cells = changes.name_of(key, units[key]), []
        for session, figures in zip(sessions, documents, strict=True):
            figure = figures.get(key) or {"value": None, "uncertainty": None}
            words = changes.uncertain_words(figure["value"], figure["uncertainty"], name)
            cells.append({"words": words, "where": figure.get("where", ""), "difference": None, "beyond": False})
            old, new = sessions[reference].state(), session.state()
            apart = changes.difference(key, old, new) if key in changes.comparable(old, new) else None
            if apart and session is not sessions[reference]:
                words = changes.uncertain_words(apart["difference"], apart["uncertainty"], name, sign=True)
                cells[-1] |= {"difference": words, "beyond": apart["beyond"]}
        table.append({"name": name.words, "unit": "" if name.unit == "1" else name.unit, "cells": cells})
    return table
