"""A participant: limits for today and the way to a test in one form, models, tests, keys and notes below."""

from __future__ import annotations

import asyncio
from typing import Any, get_args

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.charts import trend_charts
from stimrig.api.errors import ApiError
from stimrig.api.local_time import clock
from stimrig.api.models.tracking import OUTCOMES, Limits, sentences
from stimrig.api.schemas.shared import NoteKind
from stimrig.api.services import notes, participants
from stimrig.api.sessions import controllers
from stimrig.api.store.tables import Recording
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import limits_form, next_view, render, starting
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)
environment.globals["note_kinds"] = {kind: kind.capitalize() for kind in get_args(NoteKind)}  # type: ignore
environment.globals["muscles"] = ("biceps brachii", "triceps brachii")  # type: ignore
"""Offered where a muscle is typed; any other may be."""


@router.get("/participants/{code}")
async def participant(request: Request, context: Ctx, principal: Tester, code: str) -> Response:
    """Show limits, the next step, and the history of tests and models."""

    def gather() -> dict[str, Any]:
        row, status = participants.find(context, code), context.rig.status
        models, limit = context.versions.of(code), render.rows_shown(request)
        tests = context.runner.documents(code, models, limit and limit + 1)
        return {
            "participant": row,
            "notes": notes.of_participant(context.store, code),
            "calibrated": starting.calibrated(context, row),
            "step": next_view.step(context, row, principal),
            "meanwhile": participants.effect_on_open_work(context, code),
            "fields": limits_form.fields(row.profile, status),
            "tests": tests[:limit],
            "models": models[:limit],
            "more": limit is not None and max(len(models), len(tests)) > limit,
            "keys": controllers.keys_of(context.auth, code),
            "trials": trials_card(context, code),
            "trials_key": next_view.trials_key(context, code),
            "sensor": limits_form.has_sensor(status),
        }

    ask_password = not context.people.is_confirmed(principal)
    return page(request, "participant.html", ask_password=ask_password, **await asyncio.to_thread(gather))


def trials_card(context: Context, code: str) -> dict[str, Any] | None:
    """Return what the card of a controller's trials shows; None where no model may be tracked today."""
    approval = context.tracked.allowing(code)
    try:
        tracked = context.tracked.document(code) if approval is not None else None
    except ApiError:  # the model is damaged: its own page says so
        return None
    if approval is None or tracked is None:
        return None
    model = context.versions.get(approval.model_id)
    recording: Recording = context.store.get(Recording, model.recording_id)
    bounds = Limits(**(approval.tracking or {})).bounds(tracked["threshold_us"])
    return {
        **tracked,
        "panels": trend_charts.trial_panels(tracked["trials"], bounds) if tracked["trials"] else [],
        "sentences": sentences(tracked["trials"], recording.created_utc),
        "served": served_words(tracked),
        "rows": [trial_row(trial) for trial in reversed(tracked["trials"])],
    }


def served_words(tracked: dict[str, Any]) -> str:
    """Say which model the controller gets."""
    if not tracked["served_trial"]:
        return "The controller gets the approved model."
    return f"The controller gets the model as of trial {tracked['served_trial']}, {clock(tracked['served_utc'])}."


def trial_row(trial: dict[str, Any]) -> dict[str, Any]:
    """Return a trial as a row of the table."""
    cells = [trend_charts.trial_words(trial, name) for name in trend_charts.TRIAL_FIGURES]
    return {**trial, "cells": cells, "words": OUTCOMES[trial["outcome"]]}
