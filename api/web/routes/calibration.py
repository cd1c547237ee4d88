"""The participant's profile, found in a guided calibration: one short train for each step a person asks for."""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import zlib
from typing import Any

from fastapi import APIRouter, Response
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError
from stimrig.api.sessions import profiles
from stimrig.api.sessions.playing import refuse_archived
from stimrig.api.sessions.requests import CalibrationIn, MarkIn, StepIn
from stimrig.api.store import audit, seen
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, Tester
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.people import CalibratedOut, CalibrationOut
from stimrig.api.web.routes import participants
from stimrig.rig import messages, requests

router = APIRouter(prefix="/v1/participants/{code}/calibration", tags=["calibration"], responses=PROBLEM)


def _write_begin(context: Context, by: str, code: str, asked: dict[str, Any]) -> str:
    """The intent; the calibration's id."""
    with context.store.write() as session:
        seen.check(session, seen.participant(code))
        begun, now = seen.newest(session, ""), context.clock.utc()
        stamp = now[:19].replace("-", "").replace(":", "")
        identity = f"C{stamp}-{secrets.token_hex(3)}-{begun.entry}-{begun.mark}"
        audit.write(session, now, by, "begin calibration", code, calibration=identity, **asked)
    return identity


def settings(body: CalibrationIn, profile: dict[str, Any]) -> dict[str, Any]:
    """How the calibration goes: what was asked for, and the participant's own current and torque where it was not.

    Raises ApiError: 422 neither the request nor the participant says one of them.
    """
    asked = body.model_dump()
    for name in ("current_ma", "max_torque_nm"):
        asked[name] = profile.get(name) if asked[name] is None else asked[name]
        if asked[name] is None:
            raise ApiError(422, "no-limits", "The participant has no limits", f"Send {name}; {name} is not known yet.")
    return asked


def check_seen(found: dict[str, Any], any_train: bool = False) -> None:
    """Refuse what was decided on another calibration, or, but with `any_train`, without knowing of the last train.

    Raises ApiError: 409 it is another one, or another train was sent or is on its way.
    """
    sent = seen.sent.get()
    if not sent:
        return
    if sent.partition(".")[0] != found["calibration_id"]:
        raise another_calibration(found["by"])
    if not any_train and (sent != found["version"] or found["playing"]):
        raise another_train()


def another_calibration(who: str) -> ApiError:
    """409: the one that was seen has ended, and somebody has begun another one."""
    detail = f"{who} has begun another calibration since this page was shown. Nothing was done. Look at that one first."
    return ApiError(409, "changed-meanwhile", "This page is out of date", detail)


def another_train() -> ApiError:
    """409: another train was sent, or another width marked."""
    detail = (
        "Another train was sent after this page was shown, or another mark was set. Nothing was done now. Look at the "
        "last train and the marks first."
    )
    return ApiError(409, "changed-meanwhile", "This page is out of date", detail)


async def _waiting(context: Context, code: str) -> messages.Calibrated | None:
    """A calibration of this participant that is closed, and was not stored."""
    status = await context.rig.fresh_status()
    waits = status.calibrated
    return waits if waits is not None and waits.participant == code and status.calibration is None else None


async def standing(context: Context, code: str) -> dict[str, Any]:
    """Where the participant's calibration stands. Raises ApiError: 404 none is open for this participant."""
    status: messages.Status = await context.rig.fresh_status()
    found = status.calibration
    if found is None or found.participant != code:
        ended = f" The rig is {status.state}: {status.reason}." if status.state == "latched" else ""
        detail = f"No calibration of {code} is open.{ended} POST /v1/participants/{code}/calibration begins one."
        error = ApiError(404, "no-calibration", "No calibration is open", detail)
        if (waits := status.calibrated) is not None and waits.participant == code:
            error.detail = "It was finished, and waits to be stored. Finish it again, or discard it, with this ETag."
            error.headers["ETag"] = f'"{waits.calibration_id}.0"'
        raise error
    return {
        **found.model_dump(),
        "rig_state": status.state,
        "playing": status.state != "calibrating",
        "outdated": await asyncio.to_thread(outdated, context, code, found),
        "version": f"{found.calibration_id}.{len(found.trains)}.{zlib.crc32(repr(found.marks_us).encode()):08x}",
    }


def outdated(context: Context, code: str, found: messages.CalibrationStatus) -> str:
    """Why a calibration that is open goes no further: the participant's limits are no longer those of its beginning."""
    with context.store.read() as session:
        begun = _begun(session, found.calibration_id)
        if begun is None:
            return "It began on other data than this service has. It sends no further train. Discard it and begin anew."
        if not seen.since(session, begun, seen.participant(code)):
            return ""
    row = participants.find(context, code)
    now = ", ".join(f"{row.profile[name]:g} {limit.unit}" for name, limit in profiles.LIMITS.items())
    return (
        f"{row.code} now has other limits ({now}) than when this calibration was begun with {found.current_ma:g} mA. "
        "It sends no further train and gives no profile. Discard it and begin anew."
    )


def _begun(session: Session, calibration_id: str) -> seen.Seen | None:
    """Where in this trail a calibration began; None: nowhere."""
    place = re.fullmatch(rf"C\w+-[0-9a-f]{{6}}-{seen.ENTRY}-{seen.MARK}", calibration_id, re.ASCII)
    begun = seen.Seen(int(place[1]), place[2], "") if place else None
    return begun if begun is not None and seen.known(session, begun) else None


async def sound(context: Context, code: str) -> dict[str, Any]:
    """Where the calibration stands, as long as it may go on.

    Raises ApiError: 404 none is open for this participant; 409 the participant's limits were changed since it was
    begun.
    """
    found = await standing(context, code)
    if found["outdated"]:
        title = "This calibration goes no further"
        raise ApiError(409, "changed-meanwhile", title, found["outdated"])
    return found


def _store(
    context: Context, code: str, result: messages.CalibrationResult, by: str, identity: str
) -> dict[str, Any] | None:  # fmt: skip
    """What was found is the profile, if nothing of that was changed since; what a calibration does not look for (the
    rest between tests) stays. Storing it again changes nothing."""
    found = result.profile.model_dump() if result.profile else None
    with context.store.write() as session:
        if found is not None:
            row = participants.within(session, code)
            begun = _begun(session, identity) or seen.Seen(0, "", "")
            changed = seen.since(session, begun, seen.participant(code))
            if any(entry.detail.get("calibration") == identity for entry in changed):
                return dict(row.profile)
            if changed:
                raise seen.overtaken(changed)
            found |= {name: value for name, value in row.profile.items() if found.get(name) is None}
            row.profile = found
        action, said = "finish calibration" if found else "discard calibration", {"calibration": identity}
        audit.write(session, context.clock.utc(), by, action, code, profile=found, recordings=result.recordings, **said)
    return found


@router.post("", status_code=201, **describe_answer(CalibrationOut, 201, "open; nothing was sent yet"))
async def begin_calibration(
    context: Ctx, who: Tester, code: str, response: Response, body: CalibrationIn | None = None
) -> dict[str, Any]:  # fmt: skip
    """Open a guided calibration: nothing is sent until a step is asked for."""
    # What is not asked for is the participant's own, so never wider. It is bound to the limits that it is begun with:
    # the place in the audit trail at which it began ends its id, and so is kept by the rig, which may outlive this
    # service.
    body = body or CalibrationIn.model_validate({})
    async with context.limits_lock:
        row = await asyncio.to_thread(participants.find, context, code)
        refuse_archived(row)
        context.runner.refuse_second()
        asked = settings(body, row.profile)
        identity = await asyncio.to_thread(_write_begin, context, who.name, code, asked)
        last = messages.Profile.model_validate(row.profile) if body.large_steps else None
        await context.rig.ask(
            requests.CalibrateStartRequest(
                calibration_id=identity,
                participant=code,
                by=who.name,
                last=last,
                **asked,
            )
        )
        return tagged(response, await standing(context, code))


@router.get("", **describe_answer(CalibrationOut))
async def calibration(context: Ctx, _who: Tester, code: str, response: Response) -> dict[str, Any]:
    """Where it stands: width, ceiling and whose it is, marks, what is missing, every train."""
    return tagged(response, await standing(context, code))


def tagged(response: Response, found: dict[str, Any]) -> dict[str, Any]:
    """With its version as `ETag`."""
    response.headers["ETag"] = f'"{found["version"]}"'
    return found


@router.post("/step", status_code=202, **describe_answer(CalibrationOut, 202, "the train is on its way"))
async def play_step(context: Ctx, _who: Tester, code: str, body: StepIn, response: Response) -> dict[str, Any]:
    """Play one train: wider (`up`, or `fine` by a fine step), narrower, or the same again.

    It is over when `playing` is false again.
    """
    async with context.limits_lock:  # of two presses on the same sight one plays
        check_seen(await sound(context, code))
        await context.rig.ask(requests.CalibrateStepRequest(**body.model_dump()))
    return tagged(response, await standing(context, code))


@router.post("/mark", **describe_answer(CalibrationOut))
async def set_mark(context: Ctx, who: Tester, code: str, body: MarkIn, response: Response) -> dict[str, Any]:
    """Mark the last train's width as a threshold; marking again replaces."""
    async with context.limits_lock:  # no train comes between looking and marking
        found = await sound(context, code)
        check_seen(found)
        await context.rig.ask(requests.CalibrateMarkRequest(**body.model_dump()))
    action, told = f"mark {body.threshold}", {"pulse_width_us": found["pulse_width_us"]}
    await asyncio.to_thread(context.store.note, context.clock, who.name, action, code, **told)
    return tagged(response, await standing(context, code))


@router.post("/finish", **describe_answer(CalibratedOut))
async def finish_calibration(context: Ctx, who: Tester, code: str) -> dict[str, Any]:
    """Close it: the profile holds until the end of the day."""
    return await close(context, code, who.name)


@router.post("/discard", **describe_answer(CalibratedOut))
async def discard_calibration(context: Ctx, who: Tester, code: str) -> dict[str, Any]:
    """Close it and keep the profile of before; however many trains were sent."""
    return await close(context, code, who.name, discard=True)


async def close(context: Context, code: str, by: str, discard: bool = False) -> dict[str, Any]:
    """Close a calibration. The rig keeps the result until it is stored here: where that fails, finish it again."""
    async with context.limits_lock:
        waits = await _waiting(context, code)
        if waits is None:
            found = await (standing if discard else sound)(context, code)
            check_seen(found, any_train=discard)
            identity = str(found["calibration_id"])
        else:
            identity = waits.calibration_id
            if (sent := seen.sent.get()) and sent.partition(".")[0] != identity:
                raise another_calibration(waits.by)
        request = requests.CalibrateFinishRequest(by=by, discard=discard, calibration_id=identity)
        result = await context.rig.ask_for(messages.CalibrationResult, request)
        profile = await asyncio.to_thread(_store, context, code, result, by, identity)
        with contextlib.suppress(ApiError):  # it is stored, whatever the rig says now
            await context.rig.ask(requests.CalibrateStoredRequest(calibration_id=identity))
            await context.rig.fresh_status()
    return {"profile": profile, "recordings": result.recordings}
