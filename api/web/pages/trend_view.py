"""A participant's sessions over time, in pictures and a table."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.charts import trend_charts
from stimrig.api.models import changes
from stimrig.api.models.trend import newest_changes, sessions
from stimrig.api.services import participants
from stimrig.api.web.dependencies import Ctx, ModelReader
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
    )


def _cells(figures: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the value and the 95 % band of each figure of a session."""
    cells = []
    for key, name in COLUMNS.items():
        words = changes.uncertain_words(figures[key]["value"], figures[key]["uncertainty"], name)
        value, _sign, band = words.partition(" ± ")
        cells.append((value, band))
    return cells
