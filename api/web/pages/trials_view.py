"""The card of a participant's page that tells what a controller's trials said of the muscle; renewed by itself."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, Response

from stimrig.api.charts import trend_charts
from stimrig.api.clock import unix_of
from stimrig.api.errors import ApiError
from stimrig.api.language import _, clock, ngettext
from stimrig.api.models.tracking import OUTCOMES, Limits, sentences
from stimrig.api.people.auth import Principal
from stimrig.api.store import seen
from stimrig.api.store.tables import Recording
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import rig_state
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import signed
from stimrig.api.web.routes import participants

router = APIRouter(include_in_schema=False, prefix="/participants/{code}")


@router.get("/trials")
async def trials(context: Ctx, who: Tester, code: str) -> Response:
    """The card by itself, for the script that renews it; empty where there is nothing to tell."""

    def gather() -> str:
        participants.find(context, code)
        seen.looked.set(context.store.seen(context.clock))
        found = card(context, code)
        return "" if found is None else drawn(context, who, code, found)

    return HTMLResponse(await asyncio.to_thread(gather))


def drawn(context: Context, who: Principal, code: str, found: dict[str, Any]) -> str:
    """The card as HTML."""
    values = {"code": code, "ready": rig_state.now(context, who)["ready"], "signed": signed(who)}
    return environment.get_template("trials.html").render(trials=found, **values)


def card(context: Context, code: str) -> dict[str, Any] | None:
    """What the card shows; None where no model may be tracked today."""
    approval = context.tracked.allowing(code)
    try:
        told = context.tracked.document(code) if approval is not None else None
    except ApiError:  # the model is damaged: its own page says so
        return None
    if approval is None or told is None:
        return None
    model = context.versions.get(approval.model_id)
    recording: Recording = context.store.get(Recording, model.recording_id)
    bounds = Limits(**(approval.tracking or {})).bounds(told["threshold_us"])
    return {
        **told,
        "panels": trend_charts.trial_panels(told["trials"], bounds) if told["trials"] else [],
        "sentences": sentences(told["trials"], recording.created_utc),
        "age": age(context, told),
        "rows": [row(trial) for trial in reversed(told["trials"])],
        "asks": told["ask"],
    }


def age(context: Context, told: dict[str, Any]) -> str:
    """Since when that is known which the controller gets."""
    minutes = int(max(0.0, context.clock.unix_s() - unix_of(told["served_utc"])) // 60)
    ago = ngettext("%(num)s minute ago", "%(num)s minutes ago", minutes) if minutes else _("just now")
    if not told["served_trial"]:
        return _("The controller gets the approved model.")
    time = clock(told["served_utc"])
    return _(
        "The controller gets the model as of trial %(number)s, %(time)s (%(ago)s).",
        number=told["served_trial"], time=time, ago=ago,
    )  # fmt: skip


def row(trial: dict[str, Any]) -> dict[str, Any]:
    """A trial in the table."""
    cells = [trend_charts.trial_words(trial, name) for name in trend_charts.TRIAL_FIGURES]
    return {**trial, "cells": cells, "words": str(OUTCOMES[trial["outcome"]])}
