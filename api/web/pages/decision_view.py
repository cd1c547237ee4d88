"""A person decides on a model: approved or rejected; before one that is not usable, a question says what is risked."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.models import advice, headline, reasons, stored
from api.store.tables import Model
from api.web.dependencies import Approver, Context, Ctx
from api.web.pages import tracking_form
from api.web.pages.render import page
from api.web.routes import models

router = APIRouter(include_in_schema=False, prefix="/models/{model_id}")
Reason = Annotated[str, Form()]


@router.get("/approve")
async def ask(request: Request, context: Ctx, who: Approver, model_id: str) -> Response:
    """The question before a model that is not usable is approved; the model's page where none is needed."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    if not _poor(context, row):
        return RedirectResponse(f"/models/{model_id}", 303)
    return await _question(request, context, row, who.session_hash)


@router.post("/approve")
async def approve(request: Request, context: Ctx, who: Approver, model_id: str, reason: Reason = "") -> Response:
    """Let the controller have a version; one that is not usable wants a reason."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    sent = await request.form()
    tracking = tracking_form.read(sent)
    if _poor(context, row) and not reasons.is_reason(reason):
        given = {name: sent[name] for name in tracking_form.LABELS if name in sent}
        return await _question(request, context, row, who.session_hash, reason, given)
    await models.let_have(context, model_id, who.name, reason.strip()[:500], tracking)
    return RedirectResponse(f"/models/{model_id}", 303)


@router.post("/reject")
async def reject(context: Ctx, who: Approver, model_id: str, reason: Reason = "") -> Response:
    """Keep a version from the controller.

    Raises
    ------
    ApiError
        422: no reason was given.
    """
    if not reason.strip():
        detail = "Go back and say in a few words why; it is kept in the audit trail. Nothing was decided."
        raise ApiError(422, "reason-missing", "A rejection needs a reason", detail)
    await asyncio.to_thread(context.versions.decide, model_id, False, who.name, reason.strip()[:500])
    return RedirectResponse(f"/models/{model_id}", 303)


def _poor(context: Context, row: Model) -> bool:
    return context.versions.quality(row)["verdict"] in reasons.POOR


async def _question(
    request: Request, context: Context, row: Model, session: str | None, typed: str | None = None,
    sent: dict[str, Any] | None = None,
) -> Response:  # fmt: skip
    """What would be risked, and the field for the reason; with what was typed where it is no reason."""
    document = stored.read(row)
    return page(
        request,
        "approve_poor.html",
        200 if typed is None else 422,
        model=await asyncio.to_thread(context.versions.document, row),
        risks=advice.risks(document, advice.findings(document)),
        ask_password=not await context.people.is_confirmed(session),
        typed=typed,
        sent=sent,
        threshold_us=headline.threshold_us(row),
        what_to_write=reasons.WHAT_TO_WRITE,
    )
