"""A participant's sessions over time, as JSON and as CSV."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter
from fastapi.responses import Response

from stimrig.api.models import changes
from stimrig.api.models.trend import Session
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, ModelReader
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.models import TrendOut
from stimrig.api.web.routes import participants
from stimrig.identify.records.cells import lines

router = APIRouter(prefix="/v1/participants/{code}", tags=["trend"], responses=PROBLEM)
CSV: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "a row for each session; units in the head",
        "content": {"text/csv": {"schema": {"type": "string"}}},
    }
}
HEAD = (
    "session_utc", "model_id", "recording_id", "approved", "approved_by", "approved_utc", "verdict", "method",
    "effects", "versions",
)  # fmt: skip


async def sessions(context: Context, code: str) -> list[Session]:
    """A participant's sessions; 404 where there is no such participant."""
    await asyncio.to_thread(participants.find, context, code)
    return await context.trend.sessions(code)


@router.get("/trend", **describe_answer(TrendOut))
async def trend(context: Ctx, _who: ModelReader, code: str) -> dict[str, Any]:
    """Figures with their uncertainty over the sessions, and what changed since the last approved one."""
    found = await sessions(context, code)
    return {"participant": code, "sessions": [one.document() for one in found], "changes": newest(found)}


def newest(found: list[Session]) -> dict[str, Any] | None:
    """What changed from the last approved session before the newest one; None where there is none."""
    approved = [one for one in found[:-1] if one.approval is not None]
    return between(approved[-1], found[-1]) if approved else None


def between(before: Session, now: Session) -> dict[str, Any]:
    """What changed between two sessions, in figures and in words."""
    old, new = before.state(), now.state()
    return {
        "since_utc": before.at_utc,
        "since_model_id": before.model.id,
        "model_id": now.model.id,
        "differences": changes.changed(old, new),
        "sentences": changes.sentences(old, new, before.at_utc),
        "doubts": changes.doubt_sentences(old, new),
    }


@router.get("/trend.csv", response_class=Response, responses=CSV)
async def trend_csv(context: Ctx, _who: ModelReader, code: str) -> Response:
    """The same as a table: one row for each session, times in UTC, notes as text."""
    found = await sessions(context, code)
    headers = {"Content-Disposition": f'attachment; filename="trend-{code}.csv"'}
    return Response(table([one.document() for one in found]), media_type="text/csv; charset=utf-8", headers=headers)


def table(found: list[dict[str, Any]]) -> str:
    """The sessions as CSV."""
    units = {name: figure["unit"] for one in found for name, figure in one["figures"].items()}
    known = {name for one in found for name, figure in one["figures"].items() if figure["sd"] is not None}
    head = list(HEAD)
    for name, unit in units.items():
        head += [f"{name} ({unit})", *([f"{name} sd ({unit})"] if name in known else [])]
    rows = [[*head, "notes"]]
    for one in found:
        cells = [one["at_utc"], one["model_id"], one["recording_id"], "yes" if one["approved"] else "no",
                 one["approved_by"], one["approved_utc"], one["verdict"], one["method"], ", ".join(one["effects"]),
                 one["versions"]]  # fmt: skip
        for name in units:
            figure = one["figures"].get(name) or {}
            cells += [figure.get("value"), *([figure.get("sd")] if name in known else [])]
        rows.append([*cells, notes(one["notes"])])
    return "".join(lines(rows, end="\r\n"))


def notes(found: list[dict[str, Any]]) -> str:
    """The notes of a session in one cell."""
    return " | ".join(f"{note['at_utc']} {note['by']}, {note['kind']}: {note['text']}" for note in found)
