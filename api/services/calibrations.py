"""The guided calibration: one short train for each step a person asks for; its result is the participant's profile.

A calibration is bound to the limits it begins with: its id ends in the participant's version, which the rig keeps even
if this service restarts. Its own version has the trains and marks that a person was shown.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import zlib
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.services.decisions import Change, Decision
from stimrig.api.sessions import profiles
from stimrig.api.sessions.requests import CalibrationIn, MarkIn, StepIn
from stimrig.api.store import audit, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import AuditEntry, Participant
from stimrig.rig import messages, requests


async def begin(context: Context, code: str, body: CalibrationIn, decision: Decision) -> dict[str, Any]:
    """Open a calibration and return its state; on a page a current far above the usual one is confirmed first.

    Current and torque default to the participant's own. Raises ApiError: 422 nobody says one of them.
    """
    values = body.model_dump()

    def write_intent() -> tuple[Participant, str]:
        with participants.deciding(context, code, decision) as (session, row):
            for name in ("current_ma", "max_torque_nm"):
                values[name] = row.profile.get(name) if values[name] is None else values[name]
                if values[name] is None:
                    detail = f"Send {name}; {name} is not known yet."
                    raise ApiError(422, "no-limits", "The participant has no limits", detail)
            if decision.on_page:
                confirm_current(row, values, decision)
            now = context.clock.utc()
            stamp = now[:19].replace("-", "").replace(":", "")
            identity = f"C{stamp}-{secrets.token_hex(3)}-{row.version}"
            audit.write(session, now, decision.by, "begin calibration", code, calibration=identity, **values)
        return row, identity

    async with context.limits_lock:
        context.runner.refuse_second()
        row, identity = await asyncio.to_thread(write_intent)
        last = messages.Profile.model_validate(row.profile) if body.large_steps else None
        request = requests.CalibrateStartRequest(
            calibration_id=identity, participant=code, by=decision.by, last=last, **values
        )
        await context.rig.ask(request)
        return await standing(context, code)


def confirm_current(row: Participant, values: dict[str, Any], decision: Decision) -> None:
    """Ask before a calibration with a current far above the participant's."""
    if warnings := profiles.jumps(row.profile, {**row.profile, "current_ma": values["current_ma"]}):
        current = f"{values['current_ma']:g} mA"
        changes = [
            Change("Current of every pulse", current, f"{row.profile['current_ma']:g} mA"),
            Change("Fine step", f"{values['step_us']:g} µs"),
        ]
        title, button = f"Calibrate {row.code} with {current}?", f"Yes, calibrate with {current}"
        decision.require_confirmation(row.version, title, button, changes, warnings)


async def step(context: Context, code: str, body: StepIn, tags: Tags) -> dict[str, Any]:
    """Play one train and return the calibration's state."""
    await _act(context, code, tags, requests.CalibrateStepRequest(**body.model_dump()))
    return await standing(context, code)


async def mark(context: Context, code: str, body: MarkIn, by: str, tags: Tags) -> dict[str, Any]:
    """Mark the last train's width as a threshold and return the calibration's state."""
    status = await _act(context, code, tags, requests.CalibrateMarkRequest(**body.model_dump()))
    width = {"pulse_width_us": status["pulse_width_us"]}
    await asyncio.to_thread(context.store.note, context.clock, by, f"mark {body.threshold}", code, **width)
    return await standing(context, code)


async def _act(context: Context, code: str, tags: Tags, request: Any) -> dict[str, Any]:
    """Send a request about the last train that was shown; return the state before it."""
    async with context.limits_lock:  # of two presses on the same sight one counts; no train comes between
        calibration = await standing(context, code)
        _check(calibration, tags)
        await context.rig.ask(request)
    return calibration


def _check(calibration: dict[str, Any], tags: Tags, *, discard: bool = False) -> None:
    """Refuse what was decided on another calibration or another train; only discarding takes each train.

    Raises ApiError: 409 it is outdated; 412 it has ended and somebody has begun another one, or another train was sent
    or is on its way.
    """
    if calibration["outdated"] and not discard:
        raise _outdated_error(calibration["outdated"])
    words = ""
    if calibration["calibration_id"] not in {tag.partition(".")[0] for tag in tags}:
        words = f"{calibration['by']} has begun another calibration since this page was shown. Nothing was done. "
        words += "Look at that one first."
    elif not discard and (calibration["version"] not in tags or calibration["playing"]):
        words = "Another train was sent after this page was shown, or another mark was set. Nothing was done now. "
        words += "Look at the last train and the marks first."
    if words:
        raise ApiError(412, "changed-meanwhile", "This page is out of date", words)


async def standing(context: Context, code: str) -> dict[str, Any]:
    """Return the state of the participant's calibration. Raises ApiError: 404 none is open for this participant."""
    status: messages.Status = await context.rig.fresh_status()
    calibration = status.calibration
    if calibration is None or calibration.participant != code:
        ended = f" The rig is {status.state}: {status.reason}." if status.state == "latched" else ""
        detail = f"No calibration of {code} is open.{ended} POST /v1/participants/{code}/calibration begins one."
        error = ApiError(404, "no-calibration", "No calibration is open", detail)
        if (waits := status.calibrated) is not None and waits.participant == code:
            error.detail = "It was finished, and waits to be stored. Finish it again, or discard it, with this ETag."
            error.headers["ETag"] = f'"{waits.calibration_id}.0"'
        raise error

    def outdated() -> str:
        with context.store.read() as session:
            return _outdated(session, participants.within(session, code), calibration.calibration_id)

    marks = zlib.crc32(repr(calibration.marks_us).encode())
    return {
        **calibration.model_dump(),
        "rig_state": status.state,
        "playing": status.state != "calibrating",
        "outdated": await asyncio.to_thread(outdated),
        "version": f"{calibration.calibration_id}.{len(calibration.trains)}.{marks:08x}",
    }


def _outdated(session: Session, row: Participant, calibration_id: str) -> str:
    """Say why a calibration cannot go on: limits or site changed since it began; else empty.

    One that began on other data than this service has cannot go on either.
    """
    begun = re.fullmatch(r"C\w+-[0-9a-f]{6}-(\d{1,18})", calibration_id, re.ASCII)
    known = begun is not None and locking.is_known(session, int(begun[1]))
    if begun and known and not locking.since(session, int(begun[1]), locking.settings_of(row.code)):
        return ""
    now = ", ".join(f"{row.profile[name]:g} {limit.unit}" for name, limit in profiles.LIMITS.items())
    return (
        f"{row.code} now has other limits ({now}) than when this calibration was begun. It sends no further train and "
        "gives no profile. Discard it and begin anew."
    )


def _outdated_error(detail: str) -> ApiError:
    return ApiError(409, "changed-meanwhile", "This calibration goes no further", detail)


async def close(context: Context, code: str, by: str, tags: Tags, discard: bool = False) -> dict[str, Any]:
    """Close a calibration. The rig keeps the result until it is stored here: where that fails, finish it again."""
    async with context.limits_lock:
        status = await context.rig.fresh_status()
        waits = status.calibrated
        if waits is not None and waits.participant == code and status.calibration is None:
            calibration = {"calibration_id": waits.calibration_id, "by": waits.by, "outdated": ""}
            _check(calibration, tags, discard=True)  # it plays no train any more
        else:
            calibration = await standing(context, code)
            _check(calibration, tags, discard=discard)
        identity = str(calibration["calibration_id"])
        request = requests.CalibrateFinishRequest(by=by, discard=discard, calibration_id=identity)
        result = await context.rig.ask_for(messages.CalibrationResult, request)
        profile = await asyncio.to_thread(_store, context, code, result, by, identity)
        with contextlib.suppress(ApiError):  # it is stored, whatever the rig says now
            await context.rig.ask(requests.CalibrateStoredRequest(calibration_id=identity))
            await context.rig.fresh_status()
    return {"profile": profile, "recordings": result.recordings}


def _store(
    context: Context, code: str, result: messages.CalibrationResult, by: str, identity: str
) -> dict[str, Any] | None:  # fmt: skip
    """Store the calibrated profile unless the limits changed since it began; return the profile.

    Fields that a calibration does not measure (the rest between tests) stay. Storing it again changes nothing.
    """
    detail = {"calibration": identity, "recordings": result.recordings}
    with context.store.write() as session:
        row, now = participants.within(session, code), context.clock.utc()
        if result.profile is None:
            audit.write(session, now, by, "discard calibration", code, **detail)
            return None
        same = AuditEntry.detail["calibration"].as_string() == identity
        finished = AuditEntry.subject == code, AuditEntry.action == "finish calibration", same
        if session.scalar(select(AuditEntry.seq).where(*finished)) is None:
            if words := _outdated(session, row, identity):
                raise _outdated_error(words)
            row.profile = {**row.profile, **result.profile.model_dump(exclude_none=True)}
            locking.write(session, row, now, by, "finish calibration", code, profile=row.profile, **detail)
        return dict(row.profile)
