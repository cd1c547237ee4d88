"""A model's report on one sheet: verdict, curves, what is missing, who decided. One A4 page, no script."""

from __future__ import annotations

import asyncio
import json

from fastapi import APIRouter, Request
from fastapi.responses import Response

from api import reading
from api.context import Ctx, ModelReader
from api.pages import charts, why
from api.pages.drawing import svg
from api.pages.model_view import measurement
from api.pages.render import page
from api.store.tables import Recording

router = APIRouter(include_in_schema=False)
TALL, LOW = 370.0, 215.0


@router.get("/models/{model_id}/report")
async def report(request: Request, context: Ctx, _who: ModelReader, model_id: str) -> Response:
    """One sheet on a model."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    document = json.loads(row.document)
    measured = await measurement(context, row)
    found = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    recording: Recording = await asyncio.to_thread(context.store.get, Recording, row.recording_id)
    figures = charts.of_model(document, measured["curves"], measured["comparison"])
    lineage = await asyncio.to_thread(context.versions.lineage, row)
    drawn = {
        name: svg(figures[name], width, height, words)
        for name, width, height, words in (
            ("comparison", 760.0, TALL, "Torque measured and predicted, what is left, and the pulse width, over time"),
            ("recruitment", 375.0, LOW, "Steady torque over pulse width"),
            ("step", 375.0, LOW, "Step response over time"),
        )
        if name in figures
    }
    return page(
        request,
        "report_sheet.html",
        model=await asyncio.to_thread(context.versions.public, row),
        document=document,
        recruitment=reading.recruitment(document),
        dynamics=reading.dynamics(document),
        validity=reading.validity(document),
        drawn=drawn,
        problem=measured["problem"],
        why=why.view(found, measured["comparison"], row.effects) if found else None,
        versions=why.versions([context.versions.public(version) for version in lineage], row.id),
        recording=recording,
        warnings=await asyncio.to_thread(context.trials.outcomes.warnings, row.recording_id),
        now_utc=context.clock.utc(),
    )
