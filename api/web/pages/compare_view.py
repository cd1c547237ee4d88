"""Any two models or sessions of a participant, side by side: curves, figures, each against the other's recording."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from api.charts.model_charts import MODEL, STIMULUS, axis, band, band_of, layout, line
from api.errors import ApiError
from api.models import summary
from api.store.tables import Model
from api.web.dependencies import Context, Ctx, ModelReader
from api.web.pages.render import page

router = APIRouter(include_in_schema=False)
COLOURS = (MODEL, STIMULUS)
FILLS = ("rgba(11,107,117,.15)", "rgba(180,105,14,.15)")


@router.get("/compare")
async def compare(
    request: Request, context: Ctx, _who: ModelReader, model: Annotated[list[str] | None, Query()] = None
) -> Response:
    """Two models of one participant."""
    if model is None or len(model) != 2:
        detail = f"{len(model or [])} are chosen. Go back and choose two models of the participant."
        raise ApiError(422, "two-models", "Choose two models to compare", detail)
    rows = [await asyncio.to_thread(context.versions.get, model_id) for model_id in model]
    if rows[0].participant != rows[1].participant:
        detail = f"{rows[0].id} is of {rows[0].participant}, {rows[1].id} of {rows[1].participant}."
        raise ApiError(422, "two-participants", "The models are of different participants", detail)
    rows.sort(key=lambda row: row.created_utc)
    sides = await asyncio.gather(*(side(context, row, other) for row, other in zip(rows, rows[::-1], strict=True)))
    documents = [json.loads(row.document) for row in rows]
    figures = {"recruitment": recruitment(documents), "step": step([side["curves"] for side in sides])}
    return page(request, "compare.html", sides=sides, participant=rows[0].participant, figures=figures)


async def side(context: Context, row: Model, other: Model) -> dict[str, Any]:
    """One model's figures, and its error on the other one's recording."""
    document = json.loads(row.document)
    found: dict[str, Any] = {
        "model": await asyncio.to_thread(context.versions.document, row),
        "recruitment": summary.recruitment(document),
        "dynamics": summary.dynamics(document),
        "curves": None,
        "elsewhere": None,
        "same_recording": row.recording_id == other.recording_id,
    }
    try:
        found["curves"] = await context.analyses.curves(row)
        if not found["same_recording"]:
            found["elsewhere"] = await context.analyses.comparison(row, other.recording_id)
    except ApiError as error:
        found["problem"] = error
    return found


def recruitment(documents: list[dict[str, Any]]) -> dict[str, Any]:
    """Both recruitment curves with their bands."""
    data: list[dict[str, Any]] = []
    for document, name, colour, fill in zip(documents, ("earlier", "later"), COLOURS, FILLS, strict=True):
        known = band_of(document, "recruitment")
        if known:
            pair = band(known["pulse_width_us"], known["whole_lower"], known["whole_upper"])
            pair[1] |= {"fillcolor": fill, "name": "", "showlegend": False}
            data += pair
        curve = document["recruitment"]
        data.append(line(curve["pulse_width_us"], curve["torque_nm"], name, colour, 2.4))
    return {
        "data": data,
        "layout": layout(height=380, xaxis=axis("Pulse width (µs)"), yaxis=axis("Steady torque (N·m)")),
    }


def step(curves: list[dict[str, Any] | None]) -> dict[str, Any]:
    """Both step responses."""
    data = [
        line(found["step_response"]["time_s"], found["step_response"]["response"], name, colour, 2.4)
        for found, name, colour in zip(curves, ("earlier", "later"), COLOURS, strict=True)
        if found
    ]
    x, y = axis("Time (s)"), axis("Share of the final torque (1)")
    return {"data": data, "layout": layout(height=380, xaxis=x, yaxis=y)}
