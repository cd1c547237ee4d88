"""What is pressed: plain forms that do what the REST routes do, and lead back to a page."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, File, Form, UploadFile
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.web.browser_session import local
from api.web.dependencies import Ctx, Rearmer, Tester
from api.web.pages.checked import checked
from api.web.requests import ParticipantIn
from api.web.routes import participants, recordings
from api.web.routes.rig import rearm_rig

router = APIRouter(include_in_schema=False)


@router.post("/participants")
async def create_participant(
    context: Ctx, who: Tester, code: Annotated[str, Form()] = "", side: Annotated[str, Form()] = "",
    muscle: Annotated[str, Form()] = "", placement: Annotated[str, Form()] = "",
) -> Response:  # fmt: skip
    """A new participant."""
    said = {"side": side or None, "muscle": muscle.strip() or None, "placement": placement.strip() or None}
    body = checked(ParticipantIn, code=code.strip(), **said)
    row = await asyncio.to_thread(participants.create, context, body, who.name)
    return RedirectResponse(f"/participants/{row.code}", 303)


@router.post("/participants/{code}/recordings")
async def upload(
    context: Ctx, who: Tester, code: str, file: Annotated[UploadFile, File()], of: Annotated[str, Form()] = ""
) -> Response:  # fmt: skip
    """A recording of another tool, CSV or HDF5; leads to the model made from it."""
    await asyncio.to_thread(participants.find, context, code)
    data = await file.read()
    if not data:
        raise ApiError(422, "empty", "No file came", "Go back and choose a CSV file or a sealed recording (HDF5).")
    _row, model, _warnings = await recordings.take_in(context, code, data, who, of=of)
    return RedirectResponse(f"/models/{model.id}", 303)


@router.post("/rearm")
async def rearm(context: Ctx, who: Rearmer, back: Annotated[str, Form()] = "/") -> Response:
    """A person has looked, and lets the rig work again."""
    await rearm_rig(context, who.name)
    return RedirectResponse(local(back), 303)
