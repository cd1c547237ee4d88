"""A participant's sessions over time: pictures, what changed, a table; and what changed, for a model's page."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from api.charts import trend_charts
from api.models import trend_words
from api.store.tables import Model
from api.web.dependencies import Context, Ctx, ModelReader
from api.web.pages.render import page
from api.web.routes import trend as rest

router = APIRouter(include_in_schema=False)
COLUMNS = (
    "threshold_us", "plateau_nm", "time_constant_s", "damping", "delay_s", "follows_percent", "noise_sd_nm",
    "charge_uc", "current_ma",
)  # fmt: skip
MOST_COMPARED = 6


@router.get("/participants/{code}/trend")
async def trend(request: Request, context: Ctx, _who: ModelReader, code: str) -> Response:
    """All sessions in one picture."""
    found = await rest.sessions(context, code)
    documents = [one.shown() for one in found]
    return page(
        request,
        "trend.html",
        participant=code,
        sessions=[row(one) for one in reversed(documents)],
        panels=trend_charts.panels(documents),
        changes=rest.newest(found),
        columns=[(name.words, "" if name.unit == "1" else name.unit) for name in map(trend_words.name_of, COLUMNS)],
        most=MOST_COMPARED,
    )


def row(session: dict[str, Any]) -> dict[str, Any]:
    """A session in the table."""
    names = [(figure, trend_words.name_of(figure)) for figure in COLUMNS]
    cells = [cell(session["figures"][figure], name) for figure, name in names if figure in session["figures"]]
    return {**session, "cells": cells}


def cell(figure: dict[str, Any], name: trend_words.Name) -> dict[str, Any]:
    """A figure with its 95 % band; `where`: on which pulses it was found, where that is not always the same."""
    words, _sign, band = trend_words.with_uncertainty(figure["value"], figure["uncertainty"], name).partition(" ± ")
    return {"name": name.words, "words": words, "band": band, "where": figure.get("where", "")}


async def changes_of(context: Context, model: Model) -> dict[str, Any] | None:
    """What changed from the last approved session to this model (`changes.html`); None: there is no such session."""
    pair = await context.trend.against(model)
    return rest.between(*pair) if pair else None
