"""The page before a model that is not usable is approved, and the words of how far an approved model is tracked."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.models import advice, registry, stored_model
from stimrig.api.models.tracking import QUANTITIES, Limits
from stimrig.api.web.dependencies import Approver, Ctx, Version
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)


@router.get("/models/{model_id}/approve")
async def show_risks(request: Request, context: Ctx, principal: Approver, row: Version) -> Response:
    """Show the risks of a model that is not usable, and the field for the reason; else lead to the model's page."""
    document = stored_model.read(row)
    if stored_model.quality(document)["verdict"] not in registry.POOR:
        return RedirectResponse(f"/models/{row.id}", 303)
    return page(
        request,
        "approve_poor.html",
        model=await asyncio.to_thread(context.versions.document, row),
        risks=advice.risks(document, advice.findings(document)),
        ask_password=not context.people.is_confirmed(principal),
        threshold_us=stored_model.threshold_us(row),
        what_to_write=registry.WHAT_TO_WRITE,
    )


def tracking_words(limits: Mapping[str, float] | None, threshold_us: float | None) -> str:
    """Say how far a model is tracked, in a sentence.

    `limits`: percentages by the names of `Limits`; None: the usual ones. `threshold_us`: threshold of the model's
    curve, µs; without one it stays as approved, whatever the limit.
    """
    allowed = Limits(**(limits or {}))
    bounds = allowed.bounds(threshold_us)
    if not bounds:
        return "The model does not follow the muscle from trial to trial: all stays as approved."
    percent = dict(zip(QUANTITIES, allowed.model_dump().values(), strict=True))
    gain, threshold, time_scale = (
        f"±{percent[quantity]:g}\u00a0%" if quantity in bounds else "as approved" for quantity in QUANTITIES
    )
    if shift_us := bounds.get("threshold_shift_us", (0.0, 0.0))[1]:
        threshold += f" (±{shift_us:.3g}\u00a0µs)"
    return (
        f"The model follows the muscle from trial to trial, at most: gain {gain}, threshold {threshold}, "
        f"time scale {time_scale}."
    )


environment.globals["tracking_words"] = tracking_words
environment.globals["usual_tracking"] = Limits().model_dump()
