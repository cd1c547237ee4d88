"""A participant's sessions over time, as JSON and as CSV."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.responses import Response

from stimrig.api.models.trend import newest_changes
from stimrig.api.services import participants
from stimrig.api.web.dependencies import PROBLEM, Ctx, ModelReader
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.models import TrendOut
from stimrig.identify.records.cells import lines

router = APIRouter(prefix="/v1/participants/{code}", tags=["trend"], responses=PROBLEM)
CSV: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "a row for each session; units in the head",
        "content": {"text/csv": {"schema": {"type": "string"}}},
    }
}
COLUMNS = ("model_id", "recording_id", "approved", "approved_by", "approved_utc", "verdict", "method", "effects",
           "versions")  # fmt: skip


@router.get("/trend", **describe_answer(TrendOut))
def trend(context: Ctx, _principal: ModelReader, code: str) -> dict[str, Any]:
    """Figures with their uncertainty over the sessions, and what changed since the last approved one."""
    participants.find(context, code)
    sessions = context.trend.sessions(code)
    documents = [session.document() for session in sessions]
    return {"participant": code, "sessions": documents, "changes": newest_changes(sessions)}


@router.get("/trend.csv", response_class=Response, responses=CSV)
def trend_csv(context: Ctx, _principal: ModelReader, code: str) -> Response:
    """The same as a table: one row for each session, times in UTC, notes as text."""
    participants.find(context, code)
    text = table([session.document() for session in context.trend.sessions(code)])
    headers = {"Content-Disposition": f'attachment; filename="trend-{code}.csv"'}
    return Response(text, media_type="text/csv; charset=utf-8", headers=headers)


def table(sessions: list[dict[str, Any]]) -> str:
    """Return the sessions as CSV."""
    figures = {(name, "value"): figure["unit"] for session in sessions for name, figure in session["figures"].items()}
    figures |= {(name, "sd"): figure["unit"] for session in sessions for name, figure in session["figures"].items()
                if figure["sd"] is not None}  # fmt: skip
    order = list(dict.fromkeys(name for name, _key in figures))
    cells = sorted(figures, key=lambda cell: (order.index(cell[0]), cell[1] == "sd"))
    heads = [f"{name} ({figures[name, key]})" if key == "value" else f"{name} sd ({figures[name, key]})"
             for name, key in cells]  # fmt: skip
    rows: list[list[Any]] = [["session_utc", *COLUMNS, *heads, "notes"]]
    for session in sessions:
        cells_of = {**session, "approved": "yes" if session["approved"] else "no",
                 "effects": ", ".join(session["effects"])}  # fmt: skip
        values = [(session["figures"].get(name) or {}).get(key) for name, key in cells]
        notes = [f"{note['at_utc']} {note['by']}, {note['kind']}: {note['text']}" for note in session["notes"]]
        rows.append([session["at_utc"], *(cells_of[name] for name in COLUMNS), *values, " | ".join(notes)])
    return "".join(lines(rows, end="\r\n"))
