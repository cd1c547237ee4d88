"""Keys of controllers on a participant's page: made by whoever may approve, revoked by whoever runs tests."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response
from pydantic import StringConstraints

from stimrig.api.errors import NotFoundError
from stimrig.api.people import controller_keys
from stimrig.api.sessions.controller_trials import PlanIn, plan_within
from stimrig.api.sessions.playing import refuse_archived
from stimrig.api.store import seen
from stimrig.api.web.dependencies import Approver, Ctx, Tester
from stimrig.api.web.pages import participant_view, typed
from stimrig.api.web.routes import participants

router = APIRouter(include_in_schema=False, prefix="/participants/{code}/keys")
Text = Annotated[str, Form()]


class KeyFor(PlanIn):
    """A key's name and plan."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_. -]{1,60}$")]


@router.post("")
async def make(
    request: Request, context: Ctx, who: Approver, code: str, name: Text = "", current_ma: Text = "",
    max_pulse_width_us: Text = "", max_duration_s: Text = "", trials: Text = "",
) -> Response:  # fmt: skip
    """A key that ends with its day; its text is shown on the answering page only."""
    row = await asyncio.to_thread(participants.find, context, code)
    controller_keys.refuse_without(who)
    refuse_archived(row)
    about = (seen.participant(code), seen.decisions(code))
    await asyncio.to_thread(context.store.refuse_changed, *about)
    asked = {"current_ma": current_ma, "max_pulse_width_us": max_pulse_width_us, "max_duration_s": max_duration_s}
    numbers = {field: typed.wanted(text, lambda why, field=field: f"{field}: {why}.") for field, text in asked.items()}
    body = typed.checked(KeyFor, name=name.strip(), trials=typed.whole(trials), **numbers)
    plan = plan_within(PlanIn(**body.model_dump(exclude={"name"})), row)
    text, made = await asyncio.to_thread(
        controller_keys.make, context.auth, body.name, code, plan, who.name, who.token_hash
    )
    return await participant_view.shown(request, context, who, code, made={"text": text, "name": made.name})


@router.post("/{key_id}/revoke")
async def revoke(context: Ctx, who: Tester, code: str, key_id: str) -> Response:
    """It opens nothing any more."""
    if not await asyncio.to_thread(controller_keys.revoke, context.auth, code, key_id, who.name):
        raise NotFoundError("key", key_id, "The participant's page lists them.")
    return RedirectResponse(f"/participants/{code}#keys", 303)
