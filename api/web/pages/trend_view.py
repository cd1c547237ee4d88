"""A participant's sessions over time, in pictures and a table; and two to six models or sessions side by side."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from stimrig.api import local_time
from stimrig.api.charts import model_charts, trend_charts
from stimrig.api.charts.drawing import svg
from stimrig.api.charts.model_charts import COLOURS, DASHES, MAX_COMPARED
from stimrig.api.errors import ApiError
from stimrig.api.models import changes, stored_model
from stimrig.api.models.trend import Session, newest_changes, sessions, sessions_of_models
from stimrig.api.services import participants
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader
from stimrig.api.web.pages.render import page, rows_shown

router = APIRouter(include_in_schema=False)
COLUMNS = {**changes.NAMES, **changes.LAST_NAMES}


@router.get("/participants/{code}/trend")
def trend(request: Request, context: Ctx, _principal: ModelReader, code: str) -> Response:
    """Show all sessions in one picture."""
    participants.find(context, code)
    known = sessions(context.store, code)
    documents = [session.document() for session in known]
    rows = documents[::-1][: rows_shown(request)]
    return page(
        request,
        "trend.html",
        participant=code,
        sessions=[{**session, "cells": _cells(session["figures"])} for session in rows],
        more=len(documents) > len(rows),
        panels=trend_charts.panels(documents),
        changes=newest_changes(known),
        columns=COLUMNS.values(),
        most=MAX_COMPARED,
    )


def _cells(figures: dict[str, dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Return name, value and 95 % band of each figure of a session."""
    cells = []
    for key, name in COLUMNS.items():
        words = changes.uncertain_words(figures[key]["value"], figures[key]["uncertainty"], name)
        value, _sign, band = words.partition(" ± ")
        cells.append((name.words, value, band))
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
    rows = await asyncio.to_thread(_chosen, context, model or [])
    sides = await asyncio.gather(*(_side(context, rows, number) for number in range(len(rows))))

    def write() -> Response:
        participant = rows[0].participant
        known = sessions_of_models(context.store, participant, [row.id for row in rows])
        number = next((number for number, row in enumerate(rows) if row.id == reference), 0)
        names, state = [local_time.when(row.created_utc) for row in rows], known[number].state()
        documents, curves = [stored_model.read(row) for row in rows], [side["curves"] for side in sides]
        return page(
            request,
            "compare.html",
            participant=participant,
            sides=sides,
            reference=number,
            table=comparison(known, number),
            doubts=[
                (name, words) for name, session in zip(names, known, strict=True) if session is not known[number]
                for words in changes.doubt_sentences(state, session.state())
            ],
            drawn={
                title: svg(figure, 560.0, label=f"{title} of all models")
                for title, figure in model_charts.compared(documents, curves, names).items()
            },
        )  # fmt: skip

    return await asyncio.to_thread(write)


def _chosen(context: Context, model_ids: list[str]) -> list[Model]:
    """Return the models, the oldest first; 422 if they are too few, too many, or of different participants."""
    ids = list(dict.fromkeys(model_ids))
    if not 2 <= len(ids) <= MAX_COMPARED:
        detail = f"{len(ids)} are chosen. Go back and choose 2 to {MAX_COMPARED} models of the participant."
        raise ApiError(422, "two-models", "Choose two models or more to compare", detail)
    rows = [context.versions.get(model_id) for model_id in ids]
    other = next((row for row in rows if row.participant != rows[0].participant), None)
    if other is not None:
        detail = f"{rows[0].id} is of {rows[0].participant}, {other.id} of {other.participant}."
        raise ApiError(422, "two-participants", "The models are of different participants", detail)
    return sorted(rows, key=lambda row: row.created_utc)


async def _side(context: Context, rows: Sequence[Model], number: int) -> dict[str, Any]:
    """Return one model; of two, also its error on the other one's recording."""
    row, other = rows[number], rows[1 - number] if len(rows) == 2 else None
    side: dict[str, Any] = {
        "model": await asyncio.to_thread(context.versions.document, row), "colour": COLOURS[number],
        "dash": DASHES[number], "curves": None, "elsewhere": None, "problem": None,
    }  # fmt: skip
    try:
        side["curves"] = await context.analyses.curves(row)
        if other is not None and row.recording_id != other.recording_id:
            side["elsewhere"] = await context.analyses.comparison(row, other.recording_id)
    except ApiError as error:
        side["problem"] = error
    return side


def comparison(known: Sequence[Session], reference: int) -> list[dict[str, Any]]:
    """Return a row for each figure: the value of every model, and how far it is from the reference's."""
    documents, states = [session.document()["figures"] for session in known], [session.state() for session in known]
    table = []
    for key in changes.in_order(key for figures in documents for key in figures):
        present = [figures.get(key) for figures in documents]
        name, cells = changes.name_of(key, next((figure["unit"] for figure in present if figure), "")), []
        for number, (figure, state) in enumerate(zip(present, states, strict=True)):
            words = changes.uncertain_words(figure["value"], figure["uncertainty"], name) if figure else "–"
            cell = {"words": words, "difference": None, "beyond": False}
            apart = changes.difference(key, states[reference], state)
            if apart and number != reference and key in changes.comparable(states[reference], state):
                words = changes.uncertain_words(apart["difference"], apart["uncertainty"], name, sign=True)
                cell |= {"difference": words, "beyond": apart["beyond"]}
            cells.append(cell)
        table.append({"name": name.words, "unit": name.unit, "cells": cells})
    return table
