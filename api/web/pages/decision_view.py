"""A person decides on a model: approved, and how far it may be tracked, or rejected.

Before one that is not usable is approved, a question says what is risked.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from starlette.datastructures import FormData

from stimrig.api.errors import ApiError
from stimrig.api.models import advice, registry, stored_model
from stimrig.api.models.tracking import QUANTITIES, Limits
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Approver, Context, Ctx, Version
from stimrig.api.web.pages import typed
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.typed import Text
from stimrig.api.web.routes import models

router = APIRouter(include_in_schema=False, prefix="/models/{model_id}")
LABELS = {
    "gain_percent": "Gain (± %)",
    "threshold_percent": "Threshold (± %)",
    "time_scale_percent": "Time scale (± %)",
}


@router.get("/approve")
async def ask(request: Request, context: Ctx, who: Approver, row: Version) -> Response:
    """The question before a model that is not usable is approved; the model's page where none is needed."""
    if not _poor(context, row):
        return RedirectResponse(f"/models/{row.id}", 303)
    return await _question(request, context, row, who.session_hash)


@router.post("/approve")
async def approve(request: Request, context: Ctx, who: Approver, row: Version, reason: Text = "") -> Response:
    """Let the controller have a version; one that is not usable wants a reason."""
    sent = await request.form()
    tracking = read_tracking(sent)
    if _poor(context, row) and not registry.is_reason(reason):
        given = {name: sent[name] for name in LABELS if name in sent}
        return await _question(request, context, row, who.session_hash, reason, given)
    await models.let_have(context, row, who.name, reason.strip()[:500], tracking)
    return RedirectResponse(f"/models/{row.id}", 303)


@router.post("/reject")
async def reject(context: Ctx, who: Approver, model_id: str, reason: Text = "") -> Response:
    """Keep a version from the controller. Raises ApiError: 422 no reason was given."""
    if not reason.strip():
        detail = "Go back and say in a few words why; it is kept in the audit trail. Nothing was decided."
        raise ApiError(422, "reason-missing", "A rejection needs a reason", detail)
    await asyncio.to_thread(context.versions.decide, model_id, False, who.name, reason.strip()[:500])
    return RedirectResponse(f"/models/{model_id}", 303)


def _poor(context: Context, row: Model) -> bool:
    return context.versions.quality(row)["verdict"] in registry.POOR


async def _question(
    request: Request, context: Context, row: Model, session: str | None, written: str | None = None,
    sent: dict[str, Any] | None = None,
) -> Response:  # fmt: skip
    """What would be risked, and the field for the reason; with what was typed where it is no reason."""
    document = stored_model.read(row)
    return page(
        request,
        "approve_poor.html",
        200 if written is None else 422,
        model=await asyncio.to_thread(context.versions.document, row),
        risks=advice.risks(document, advice.findings(document)),
        ask_password=not await context.people.is_confirmed(session),
        typed=written,
        sent=sent,
        threshold_us=stored_model.threshold_us(row),
        what_to_write=registry.WHAT_TO_WRITE,
    )


def read_tracking(sent: FormData) -> Limits:
    """The limits that were typed; the usual ones where the form has no such field.

    Raises ApiError: 422 what was typed is no percentage from 0 to 60.
    """
    found: dict[str, float] = {}
    for name in Limits.model_fields:
        text = sent.get(name)
        if text is None:
            continue
        found[name] = typed.wanted(str(text), lambda error, name=name: f"{name}: {error}. Nothing was decided.")
    return typed.checked(Limits, **found)


def tracking_fields(sent: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """The form's fields, with what was typed in them."""
    given = {name: typed.number_text(percent) for name, percent in Limits().model_dump().items()} | dict(sent or {})
    return [{"name": name, "label": str(label), "text": str(given[name])[:5]} for name, label in LABELS.items()]


def tracking_words(limits: Mapping[str, Any] | None, threshold_us: float | None) -> str:
    """What is allowed, in a sentence.

    `limits`: of `LABELS`, each in percent, or as it was typed; None: the usual ones. `threshold_us`: of the model's
    curve, µs; without one its threshold stays as approved, whatever the limit.
    """
    given = {
        name: typed.number(str(value)) if isinstance(value, str) else value for name, value in (limits or {}).items()
    }
    allowed = Limits(**given)
    bounds = allowed.bounds(threshold_us)
    if not bounds:
        return "The model does not follow the muscle from trial to trial: all stays as approved."
    said = {
        quantity: f"±{typed.number_text(percent)}\u00a0%" if quantity in bounds else "as approved"
        for quantity, percent in zip(QUANTITIES, allowed.model_dump().values(), strict=True)
    }
    if shift_us := bounds.get("threshold_shift_us", (0.0, 0.0))[1]:
        said["threshold_shift_us"] += f" (±{shift_us:.3g}\u00a0µs)"
    return (
        f"The model follows the muscle from trial to trial, at most: gain {said['gain']}, "
        f"threshold {said['threshold_shift_us']}, time scale {said['time_scale']}."
    )


environment.globals["tracking_fields"] = tracking_fields
environment.globals["tracking_words"] = tracking_words
