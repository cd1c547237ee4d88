"""What is next for a participant, gathered for the page: the rig, the calibration, today's tests and models."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter

from stimrig.api import language
from stimrig.api.models import next_step
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store.tables import OPEN_STATES, Model, Participant, Test
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import rig_state, starting
from stimrig.api.web.routes import participants

router = APIRouter(include_in_schema=False)


@router.get("/participants/{code}/next")
async def key(context: Ctx, _who: Tester, code: str) -> dict[str, str]:
    """Whether the line is still the one that the page shows."""
    row = await asyncio.to_thread(participants.find, context, code)
    return {"key": (await asyncio.to_thread(step, context, row)).key}


def step(context: Context, row: Participant) -> next_step.Step:
    """The participant's next step now."""
    return next_step.of(situation(context, row))


def situation(context: Context, row: Participant) -> next_step.Situation:
    """Everything that the next step depends on."""
    standing = starting.calibrated(context, row)
    state, current = rig_state.state_of(context), context.runner.current
    opened = context.rig.status.calibration if context.rig.status else None
    holder = current.participant if current else opened.participant if opened else ""
    test = _last_test(context, row.code)
    open_test = test is not None and test.state in OPEN_STATES
    mine = current is not None and test is not None and current.test_id == test.id
    models = _models_of_today(context, row.code)
    counting = ((row, words == "approved") for row, words in models if _to_look_at(row, words))
    kept, decided = next(counting, (None, False))
    served = context.versions.approved(row.code)
    return next_step.Situation(
        code=row.code,
        rig=state,
        calibration=standing.state,
        may_start=standing.may_start,
        holder=holder,
        running=test.id if test is not None and mine and not (served and test.kind == SEQUENCE) else "",
        identifying=test.id if test is not None and open_test and not mine else "",
        ended=test.state if test is not None and test.state in next_step.NO_MODEL and test.kind != SEQUENCE else "",
        model=kept and next_step.Today(kept.id, context.versions.quality(kept)["verdict"], decided),
        rejected=bool(models) and kept is None,
        served_until=language.until(served.expires_utc or context.clock.end_of_day_utc())[-5:] if served else "",
        archived_since=language.when(row.archived_utc) if row.archived_utc else "",
        asked=served is not None and context.tracked.asks(served.id) is not None,
    )


def _last_test(context: Context, code: str) -> Test | None:
    """The newest test of today."""
    found = context.store.all(
        Test, Test.participant == code, Test.requested_utc >= context.clock.start_of_day_utc(),
        order=Test.requested_utc.desc(), limit=1,
    )  # fmt: skip
    return found[0] if found else None


def _models_of_today(context: Context, code: str) -> list[tuple[Model, str | None]]:
    """The participant's versions that were made today, newest first, each with what was decided on it."""
    rows = context.store.all(
        Model,
        Model.participant == code,
        Model.created_utc >= context.clock.start_of_day_utc(),
        order=Model.created_utc.desc(),
    )
    decisions = [context.versions.decision(row.id) for row in rows]
    words = [None if found is None else "approved" if found.approved else "rejected" for found in decisions]
    return list(zip(rows, words, strict=True))


def _to_look_at(row: Model, decision: str | None) -> bool:
    """Whether a version counts: not a rejected one, nor one in last time's structure where the plain one is better."""
    offered = row.carried_from_id is None or (row.carried or {}).get("offered") != "plain"
    return decision == "approved" or (decision is None and offered)
