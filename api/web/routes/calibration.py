"""The participant's profile, found in a guided calibration: one short train for each step a person asks for."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter

from api.errors import ApiError
from api.sessions import profiles
from api.sessions.refusals import refuse_archived
from api.sessions.requests import CalibrationIn, FinishIn, MarkIn, StepIn
from api.store import audit
from api.store.holds import LIMITS_TURN
from api.store.tables import Participant
from api.web.dependencies import PROBLEM, Context, Ctx, Tester
from api.web.responses.base import answers
from api.web.responses.participants import CalibratedOut, CalibrationOut
from api.web.routes import participants
from rig.messages import (
    CalibrateFinishRequest,
    CalibrateMarkRequest,
    CalibrateStartRequest,
    CalibrateStepRequest,
    CalibrationResult,
    CalibrationStatus,
    Profile,
    Status,
)

router = APIRouter(prefix="/v1/participants/{code}/calibration", tags=["calibration"], responses=PROBLEM)


async def begin(
    context: Context, code: str, body: CalibrationIn, by: str, seen: str | None = None
) -> dict[str, Any]:  # fmt: skip
    """Open a calibration; nothing is sent yet. What is not asked for is the participant's own, so never wider.

    It is bound to the limits that it is begun with; `seen`, their version that a person was shown.
    """
    async with context.holds.turn(LIMITS_TURN):
        row = await asyncio.to_thread(participants.find, context, code)
        refuse_archived(row)
        context.runner.refuse_second()
        version = profiles.version(row.profile)
        if seen not in (None, version):
            raise participants.stale(row)
        stamp = context.clock.utc()[:19].replace("-", "").replace(":", "")
        identity = f"C{stamp}-{secrets.token_hex(3)}-{version}"
        asked = settings(body, row.profile)
        await asyncio.to_thread(note, context, by, "begin calibration", code, calibration=identity, **asked)
        last = Profile.model_validate(row.profile) if body.large_steps else None
        await context.rig.ask(
            CalibrateStartRequest(calibration_id=identity, participant=code, by=by, last=last, **asked)
        )
        return await standing(context, code)


def settings(body: CalibrationIn, profile: dict[str, Any]) -> dict[str, Any]:
    """How the calibration goes: what was asked for, and the participant's own current and torque where it was not.

    Raises
    ------
    ApiError
        422: neither the request nor the participant says one of them.
    """
    asked = body.model_dump()
    for name in ("current_ma", "max_torque_nm"):
        asked[name] = profile.get(name) if asked[name] is None else asked[name]
        if asked[name] is None:
            raise ApiError(422, "no-limits", "The participant has no limits", f"Send {name}; {name} is not known yet.")
    return asked


@dataclass(frozen=True)
class Shown:
    """What a page showed when a button on it was pressed; None: not said."""

    calibration: str | None = None
    """Its id."""
    trains: str | None = None
    """How many had been sent."""

    def check(self, found: dict[str, Any]) -> None:
        """Refuse what was pressed on a page that shows another calibration, or does not know of the last train.

        Raises
        ------
        ApiError
            409: it is another one, or another train was sent or is on its way.
        """
        same = self.calibration in (None, found["calibration_id"])
        if same and (self.trains is None or (self.trains == str(len(found["trains"])) and not found["playing"])):
            return
        detail = "Another train was sent after this page was shown. Nothing was done now. Look at the last train first."
        raise ApiError(409, "not-what-was-seen", "This page is out of date", detail)


NOT_SAID = Shown()


async def step(context: Context, code: str, body: StepIn, shown: Shown = NOT_SAID) -> dict[str, Any]:
    """Play one train. Looking and playing are one turn: of two presses on the same sight one plays."""
    async with context.holds.turn(LIMITS_TURN):
        shown.check(await sound(context, code))
        await context.rig.ask(CalibrateStepRequest(direction=body.direction, shown_us=body.shown_us))
    return await standing(context, code)


async def mark(context: Context, code: str, threshold: Any, by: str, shown: Shown = NOT_SAID) -> dict[str, Any]:
    """Mark the last train's width; no train comes between looking and marking."""
    async with context.holds.turn(LIMITS_TURN):
        found = await sound(context, code)
        shown.check(found)
        await context.rig.ask(CalibrateMarkRequest(threshold=threshold))
    await asyncio.to_thread(note, context, by, f"mark {threshold}", code, pulse_width_us=found["pulse_width_us"])
    return await standing(context, code)


async def finish(
    context: Context, code: str, discard: bool, by: str, shown: Shown = NOT_SAID
) -> dict[str, Any]:  # fmt: skip
    """Close it; unless discarded, what it found is the participant's profile for the day."""
    async with context.holds.turn(LIMITS_TURN):
        found = await (standing if discard else sound)(context, code)
        shown.check(found)
        result = await context.rig.ask_for(CalibrationResult, CalibrateFinishRequest(by=by, discard=discard))
        version = profiles.of_calibration(found["calibration_id"])
        profile = await asyncio.to_thread(_store, context, code, result, by, version)
        with contextlib.suppress(ApiError):  # the rig has let it go: what was found is stored whatever it says now
            await context.rig.fresh_status()
    return {"profile": profile, "recordings": result.recordings}


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
    row = await asyncio.to_thread(participants.find, context, code)
    playing = status.state != "calibrating"
    return {**found.model_dump(), "rig_state": status.state, "playing": playing, "outdated": outdated(row, found)}


def outdated(row: Participant, found: CalibrationStatus) -> str:
    """Why a calibration that is open goes no further: the participant's limits are no longer those of its beginning."""
    if profiles.of_calibration(found.calibration_id) == profiles.version(row.profile):
        return ""
    now = ", ".join(f"{row.profile[name]:g} {limit.unit}" for name, limit in profiles.LIMITS.items())
    return (
        f"{row.code} now has other limits ({now}) than when this calibration was begun with {found.current_ma:g} mA. "
        "It sends no further train and gives no profile. Discard it and begin anew."
    )


async def sound(context: Context, code: str) -> dict[str, Any]:
    """Where the calibration stands, as long as it may go on.

    Raises
    ------
    ApiError
        404: none is open for this participant; 409: the participant's limits were changed since it was begun.
    """
    found = await standing(context, code)
    if found["outdated"]:
        raise ApiError(409, "changed-meanwhile", "The limits were changed by someone else", found["outdated"])
    return found


def note(context: Context, by: str, action: str, code: str, **detail: Any) -> None:
    """An entry in the audit trail."""
    with context.store.write() as session:
        audit.write(session, context.clock.utc(), by, action, code, **detail)


def _store(
    context: Context, code: str, result: CalibrationResult, by: str, version: str
) -> dict[str, Any] | None:  # fmt: skip
    """What was found is the profile, if that is still of this version; what a calibration does not look for (the rest
    between tests) stays."""
    found = result.profile.model_dump() if result.profile else None
    with context.store.write() as session:
        row = session.get(Participant, code)
        assert row is not None
        if found is not None:
            if profiles.version(row.profile) != version:
                raise participants.stale(row)
            kept = {name: value for name, value in row.profile.items() if found.get(name) is None}
            found = row.profile = {**found, **kept}
        action = "finish calibration" if found else "discard calibration"
        audit.write(session, context.clock.utc(), by, action, code, profile=found, recordings=result.recordings)
    return found


@router.post("", status_code=201, **answers(CalibrationOut, 201, "open; nothing was sent yet"))
async def begin_calibration(context: Ctx, who: Tester, code: str, body: CalibrationIn | None = None) -> dict[str, Any]:
    """Open a guided calibration: nothing is sent until a step is asked for."""
    return await begin(context, code, body or CalibrationIn.model_validate({}), who.name)


@router.get("", **answers(CalibrationOut))
async def calibration(context: Ctx, _who: Tester, code: str) -> dict[str, Any]:
    """Where it stands: width, ceiling and whose it is, marks, what is missing, every train."""
    return await standing(context, code)


@router.post("/step", status_code=202, **answers(CalibrationOut, 202, "the train is on its way"))
async def play_step(context: Ctx, _who: Tester, code: str, body: StepIn) -> dict[str, Any]:
    """Play one train: wider (`up`, or `fine` by a fine step), narrower, or the same again.

    It is over when `playing` is false again.
    """
    return await step(context, code, body)


@router.post("/mark", **answers(CalibrationOut))
async def set_mark(context: Ctx, who: Tester, code: str, body: MarkIn) -> dict[str, Any]:
    """Mark the last train's width as a threshold; marking again replaces."""
    return await mark(context, code, body.threshold, who.name)


@router.post("/finish", **answers(CalibratedOut))
async def finish_calibration(context: Ctx, who: Tester, code: str, body: FinishIn | None = None) -> dict[str, Any]:
    """Close it: the profile holds until the end of the day; `discard` leaves the old one."""
    return await finish(context, code, bool(body and body.discard), who.name)
