"""What is pressed: plain forms that do what the REST routes do, and lead back to a page."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, File, Form, UploadFile
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.web.dependencies import Approver, Context, Ctx, Rearmer, Tester
from api.web.pages.checked import checked
from api.web.requests import ParticipantIn
from api.web.routes import participants, recordings
from api.web.routes.rig import rearm_rig

router = APIRouter(include_in_schema=False)


@router.post("/participants")
async def create_participant(context: Ctx, who: Tester, code: Annotated[str, Form()] = "") -> Response:
    """A new participant."""
    body = checked(ParticipantIn, code=code.strip())
    row = await asyncio.to_thread(participants.create, context, body, who.name)
    return RedirectResponse(f"/participants/{row.code}", 303)


@router.post("/participants/{code}/recordings")
async def upload(context: Ctx, who: Tester, code: str, file: Annotated[UploadFile, File()]) -> Response:
    """A recording of another tool, CSV or HDF5; leads to the model made from it."""
    await asyncio.to_thread(participants.find, context, code)
    data = await file.read()
    if not data:
        raise ApiError(422, "empty", "No file came", "Go back and choose a CSV file or a sealed recording (HDF5).")
    _row, model, _warnings = await recordings.take_in(context, code, data, who.name)
    return RedirectResponse(f"/models/{model.id}", 303)


@router.post("/models/{model_id}/approve")
async def approve(context: Ctx, who: Approver, model_id: str, reason: Annotated[str, Form()] = "") -> Response:
    """Let the controller have a version."""
    return await decide(context, who.name, model_id, True, reason)


@router.post("/models/{model_id}/reject")
async def reject(context: Ctx, who: Approver, model_id: str, reason: Annotated[str, Form()] = "") -> Response:
    """Keep a version from the controller."""
    return await decide(context, who.name, model_id, False, reason)


async def decide(context: Context, by: str, model_id: str, approved: bool, reason: str) -> Response:
    """Write a decision down; on the page it wants a reason.

    Raises
    ------
    ApiError
        422: no reason was given.
    """
    if not reason.strip():
        detail = "Go back and say in a few words why; it is kept in the audit trail. Nothing was decided."
        raise ApiError(422, "reason-missing", "A decision needs a reason", detail)
    await asyncio.to_thread(context.versions.decide, model_id, approved, by, reason.strip()[:500])
    return RedirectResponse(f"/models/{model_id}", 303)


@router.post("/rearm")
async def rearm(context: Ctx, who: Rearmer, back: Annotated[str, Form()] = "/") -> Response:
    """A person has looked, and lets the rig work again."""
    from api.web.browser_session import local

    await rearm_rig(context, who.name)
    return RedirectResponse(local(back), 303)
