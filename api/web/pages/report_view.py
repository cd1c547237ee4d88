"""A model's report on one sheet: session, verdict, curves, what is missing, who decided, a place to sign. No script."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from api.charts import joint_charts, model_charts
from api.charts.svg import svg
from api.language import _
from api.models import advice, explanation, stored, summary
from api.store.tables import Model, Recording
from api.web.dependencies import Context, Ctx, ModelReader
from api.web.pages import session_facts
from api.web.pages.model_view import measurement
from api.web.pages.render import page

router = APIRouter(include_in_schema=False)
TALL, LOW = 312.0, 215.0


def _versions(context: Context, lineage: list[Model], shown: str) -> list[dict[str, Any]]:
    return explanation.versions([context.versions.document(version) for version in lineage], shown)


@router.get("/models/{model_id}/report")
async def report(request: Request, context: Ctx, _who: ModelReader, model_id: str) -> Response:
    """One sheet on a model."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    document = stored.read(row)
    measured = await measurement(context, row)
    found = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    recording: Recording = await asyncio.to_thread(context.store.get, Recording, row.recording_id)
    figures = model_charts.of_model(document, measured["curves"], measured["comparison"])
    figures |= joint_charts.of_joint(document)
    lineage = await asyncio.to_thread(context.versions.lineage, row)
    drawn = {
        name: svg(figures[name], width, height, words, on_paper=True)
        for name, width, height, words in (
            (
                "comparison",
                760.0,
                TALL,
                _("Torque measured and predicted, what is left, and the pulse width, over time"),
            ),
            ("recruitment", 375.0, LOW, _("Steady torque over pulse width")),
            ("step", 375.0, LOW, _("Step response over time")),
            ("joint_g", 760.0, LOW, _("Share of the muscle's torque over the angle of the joint")),
            ("joint_h", 760.0, LOW, _("Passive torque over the angle of the joint")),
        )
        if name in figures
    }
    leaves = advice.leaves_structure(advice.findings(document))
    return page(
        request,
        "report_sheet.html",
        model=await asyncio.to_thread(context.versions.document, row),
        document=document,
        recruitment=summary.recruitment(document),
        dynamics=summary.dynamics(document),
        validity=summary.validity(document),
        drawn=drawn,
        problem=measured["problem"],
        why=explanation.view(found, measured["comparison"], row.effects, leaves) if found else None,
        versions=await asyncio.to_thread(_versions, context, lineage, row.id),
        recording=recording,
        session=await asyncio.to_thread(session_facts.of, context, recording),
        warnings=await asyncio.to_thread(context.runner.lifecycle.warnings, row.recording_id),
        now_utc=context.clock.utc(),
    )
