"""The participant's profile, found in a guided calibration: one short train for each step a person asks for."""

from __future__ import annotations

import asyncio
import secrets
from typing import Any

from fastapi import APIRouter

from api import audit
from api.context import PROBLEM, Context, Ctx, Tester
from api.errors import ApiError
from api.routes import participants
from api.schemas import CalibrationIn, FinishIn, MarkIn, StepIn
from api.store.tables import Participant
from rig.messages import (
    CalibrateFinishRequest,
    CalibrateMarkRequest,
    CalibrateStartRequest,
    CalibrateStepRequest,
    CalibrationResult,
    Status,
)

router = APIRouter(prefix="/v1/participants/{code}/calibration", tags=["calibration"], responses=PROBLEM)


async def begin(context: Context, code: str, body: CalibrationIn, by: str) -> dict[str, Any]:
    """Open a calibration; nothing is sent yet."""
    await asyncio.to_thread(participants.find, context, code)
    if context.trials.current is not None:
        from api.trials import busy

        raise busy(context.trials.current)
    identity = f"C{context.clock.utc()[:19].replace('-', '').replace(':', '')}-{secrets.token_hex(3)}"
    await asyncio.to_thread(note, context, by, "begin calibration", code, calibration=identity, **body.model_dump())
    await context.rig.ask(CalibrateStartRequest(calibration_id=identity, participant=code, by=by, **body.model_dump()))
    return await standing(context, code)


async def step(context: Context, code: str, direction: Any) -> dict[str, Any]:
    """Play one train."""
    await standing(context, code)
    await context.rig.ask(CalibrateStepRequest(direction=direction))
    return await standing(context, code)


async def mark(context: Context, code: str, threshold: Any, by: str) -> dict[str, Any]:
    """Mark the last train's width."""
    found = await standing(context, code)
    await context.rig.ask(CalibrateMarkRequest(threshold=threshold))
    await asyncio.to_thread(note, context, by, f"mark {threshold}", code, pulse_width_us=found["pulse_width_us"])
    return await standing(context, code)


async def finish(context: Context, code: str, discard: bool, by: str) -> dict[str, Any]:
    """Close it; unless discarded, what it found is the participant's profile for the day."""
    await standing(context, code)
    reply = await context.rig.ask(CalibrateFinishRequest(by=by, discard=discard))
    result = CalibrationResult.model_validate(reply)
    await context.rig.fresh_status()
    await asyncio.to_thread(_store, context, code, result, by)
    return {"profile": result.profile.model_dump() if result.profile else None, "recordings": result.recordings}


async def standing(context: Context, code: str) -> dict[str, Any]:
    """Where the participant's calibration stands.

    Raises
    ------
    ApiError
        404: none is open for this participant.
    """
    status: Status = await context.rig.fresh_status()
    found = status.calibration
    if found is None or found.participant != code:
        ended = f" The rig is {status.state}: {status.reason}." if status.state == "latched" else ""
        detail = f"No calibration of {code} is open.{ended} POST /v1/participants/{code}/calibration begins one."
        raise ApiError(404, "no-calibration", "No calibration is open", detail)
    return {**found.model_dump(), "rig_state": status.state, "playing": status.state != "calibrating"}


def note(context: Context, by: str, action: str, code: str, **detail: Any) -> None:
    """An entry in the audit trail."""
    with context.store.write() as session:
        audit.write(session, context.clock.utc(), by, action, code, **detail)


def _store(context: Context, code: str, result: CalibrationResult, by: str) -> None:
    with context.store.write() as session:
        action = "finish calibration" if result.profile else "discard calibration"
        profile = result.profile.model_dump() if result.profile else None
        if profile is not None:
            row = session.get(Participant, code)
            assert row is not None
            row.profile = profile
        audit.write(session, context.clock.utc(), by, action, code, profile=profile, recordings=result.recordings)


@router.post("", status_code=201)
async def begin_calibration(context: Ctx, who: Tester, code: str, body: CalibrationIn | None = None) -> dict[str, Any]:
    """Open a guided calibration: nothing is sent until a step is asked for."""
    return await begin(context, code, body or CalibrationIn(), who.name)


@router.get("")
async def calibration(context: Ctx, _who: Tester, code: str) -> dict[str, Any]:
    """Where it stands: width, ceiling and whose it is, marks, what is missing, every train."""
    return await standing(context, code)


@router.post("/step", status_code=202)
async def play_step(context: Ctx, _who: Tester, code: str, body: StepIn) -> dict[str, Any]:
    """Play one train a step wider, a step narrower, or the same again; over when `playing` is false again."""
    return await step(context, code, body.direction)


@router.post("/mark")
async def set_mark(context: Ctx, who: Tester, code: str, body: MarkIn) -> dict[str, Any]:
    """Mark the last train's width as a threshold; marking again replaces."""
    return await mark(context, code, body.threshold, who.name)


@router.post("/finish")
async def finish_calibration(context: Ctx, who: Tester, code: str, body: FinishIn | None = None) -> dict[str, Any]:
    """Close it: the profile holds until the end of the day; `discard` leaves the old one."""
    return await finish(context, code, bool(body and body.discard), who.name)
