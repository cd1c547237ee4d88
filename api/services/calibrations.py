"""The guided calibration: one short train for each step a person asks for; its result is the participant's profile."""

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
from stimrig.api.sessions.playing import refuse_archived
from stimrig.api.sessions.requests import CalibrationIn, MarkIn, StepIn
from stimrig.api.store import audit, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import AuditEntry, Participant
from stimrig.rig import messages, requests


def _write_begin(context: Context, by: str, code: str, values: dict[str, Any], tags: Tags) -> str:
    """Write the intent to the audit trail and return the calibration's id."""
    with context.store.write() as session:
        version, now = locking.check(session, participants.within(session, code), tags), context.clock.utc()
        stamp = now[:19].replace("-", "").replace(":", "")
        identity = f"C{stamp}-{secrets.token_hex(3)}-{version}"
        audit.write(session, now, by, "begin calibration", code, calibration=identity, **values)
    return identity


def settings(body: CalibrationIn, profile: dict[str, Any]) -> dict[str, Any]:
    """Return the calibration's settings; current and torque default to the participant's own.

    Raises ApiError: 422 neither the request nor the participant says one of them.
    """
    values = body.model_dump()
    for name in ("current_ma", "max_torque_nm"):
        values[name] = profile.get(name) if values[name] is None else values[name]
        if values[name] is None:
            raise ApiError(422, "no-limits", "The participant has no limits", f"Send {name}; {name} is not known yet.")
    return values


async def begin(context: Context, code: str, body: CalibrationIn, decision: Decision) -> dict[str, Any]:
    """Open a calibration and return its state; on a page a current far above the usual one is confirmed first.

    The calibration is bound to the limits it begins with. Its id ends in the participant's version, which the rig keeps
    even if this service restarts.
    """
    async with context.limits_lock:
        row = await asyncio.to_thread(participants.find, context, code)
        refuse_archived(row)
        context.runner.refuse_second()
        values = settings(body, row.profile)
        if decision.on_page:
            confirm_current(row, values, decision)
        by = decision.by
        identity = await asyncio.to_thread(_write_begin, context, by, code, values, decision.tags)
        last = messages.Profile.model_validate(row.profile) if body.large_steps else None
        await context.rig.ask(
            requests.CalibrateStartRequest(calibration_id=identity, participant=code, by=by, last=last, **values)
        )
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
    async with context.limits_lock:  # of two presses on the same sight one plays
        check_train(await sound(context, code), tags)
        await context.rig.ask(requests.CalibrateStepRequest(**body.model_dump()))
    return await standing(context, code)


async def mark(context: Context, code: str, body: MarkIn, by: str, tags: Tags) -> dict[str, Any]:
    """Mark the last train's width as a threshold and return the calibration's state."""
    async with context.limits_lock:  # no train comes between looking and marking
        calibration = await sound(context, code)
        check_train(calibration, tags)
        await context.rig.ask(requests.CalibrateMarkRequest(**body.model_dump()))
    width = {"pulse_width_us": calibration["pulse_width_us"]}
    await asyncio.to_thread(context.store.note, context.clock, by, f"mark {body.threshold}", code, **width)
    return await standing(context, code)


def check_train(calibration: dict[str, Any], tags: Tags, any_train: bool = False) -> None:
    """Refuse what was decided on another calibration, or, but with `any_train`, without knowing of the last train.

    Raises ApiError: 412 it is another one, or another train was sent or is on its way.
    """
    check_calibration(calibration["calibration_id"], calibration["by"], tags)
    if not any_train and (calibration["version"] not in tags or calibration["playing"]):
        raise another_train()


def check_calibration(calibration_id: str, by: str, tags: Tags) -> None:
    """Raise ApiError (412): the one that was decided on has ended, and somebody has begun another one."""
    if calibration_id not in {tag.partition(".")[0] for tag in tags}:
        detail = (
            f"{by} has begun another calibration since this page was shown. Nothing was done. Look at that one first."
        )
        raise ApiError(412, "changed-meanwhile", "This page is out of date", detail)


def another_train() -> ApiError:
    """412: another train was sent, or another width marked."""
    detail = (
        "Another train was sent after this page was shown, or another mark was set. Nothing was done now. Look at the "
        "last train and the marks first."
    )
    return ApiError(412, "changed-meanwhile", "This page is out of date", detail)


async def _waiting(context: Context, code: str) -> messages.Calibrated | None:
    """Return a finished calibration of this participant that is not stored yet."""
    status = await context.rig.fresh_status()
    waits = status.calibrated
    return waits if waits is not None and waits.participant == code and status.calibration is None else None


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
    marks = zlib.crc32(repr(calibration.marks_us).encode())
    return {
        **calibration.model_dump(),
        "rig_state": status.state,
        "playing": status.state != "calibrating",
        "outdated": await asyncio.to_thread(outdated, context, code, calibration),
        "version": f"{calibration.calibration_id}.{len(calibration.trains)}.{marks:08x}",
    }


def outdated(context: Context, code: str, calibration: messages.CalibrationStatus) -> str:
    """Say why an open calibration cannot go on: the participant's limits changed since it began; else empty."""
    with context.store.read() as session:
        row = participants.within(session, code)
        return _outdated_words(row) if _changed(session, row, calibration.calibration_id) else ""


def _outdated_words(row: Participant) -> str:
    now = ", ".join(f"{row.profile[name]:g} {limit.unit}" for name, limit in profiles.LIMITS.items())
    return (
        f"{row.code} now has other limits ({now}) than when this calibration was begun. It sends no further train and "
        "gives no profile. Discard it and begin anew."
    )


def _changed(session: Session, row: Participant, calibration_id: str) -> bool:
    """Return whether limits, site or archive changed since this calibration began."""
    begun = re.fullmatch(r"C\w+-[0-9a-f]{6}-(\d{1,18})", calibration_id, re.ASCII)
    if begun is None or not locking.is_known(session, int(begun[1])):
        return True  # it began on other data than this service has
    return bool(locking.since(session, int(begun[1]), locking.settings_of(row.code)))


async def sound(context: Context, code: str) -> dict[str, Any]:
    """Return the calibration's state if it may go on.

    Raises ApiError: 404 none is open for this participant; 409 the participant's limits were changed since it was
    begun.
    """
    calibration = await standing(context, code)
    if calibration["outdated"]:
        raise outdated_error(calibration["outdated"])
    return calibration


def outdated_error(detail: str) -> ApiError:
    """409: the calibration can only be discarded."""
    return ApiError(409, "changed-meanwhile", "This calibration goes no further", detail)


def _store(
    context: Context, code: str, result: messages.CalibrationResult, by: str, identity: str
) -> dict[str, Any] | None:  # fmt: skip
    """Store the calibrated profile unless the limits changed since it began; return the profile.

    Fields that a calibration does not measure (the rest between tests) stay. Storing it again changes nothing.
    """
    new_profile = result.profile.model_dump() if result.profile else None
    detail = {"calibration": identity, "recordings": result.recordings}
    with context.store.write() as session:
        row, now = participants.within(session, code), context.clock.utc()
        if new_profile is None:
            audit.write(session, now, by, "discard calibration", code, **detail)
        elif not _stored(session, code, identity):
            if _changed(session, row, identity):
                raise outdated_error(_outdated_words(row))
            row.profile = new_profile | {
                name: value for name, value in row.profile.items() if new_profile.get(name) is None
            }
            locking.write(session, row, now, by, "finish calibration", code, profile=row.profile, **detail)
        return None if new_profile is None else dict(row.profile)


def _stored(session: Session, code: str, identity: str) -> bool:
    same = AuditEntry.detail["calibration"].as_string() == identity
    entry = select(AuditEntry.seq).where(AuditEntry.subject == code, AuditEntry.action == "finish calibration", same)
    return session.scalar(entry) is not None


async def close(context: Context, code: str, by: str, tags: Tags, discard: bool = False) -> dict[str, Any]:
    """Close a calibration. The rig keeps the result until it is stored here: where that fails, finish it again."""
    async with context.limits_lock:
        waits = await _waiting(context, code)
        if waits is None:
            calibration = await (standing if discard else sound)(context, code)
            check_train(calibration, tags, any_train=discard)
            identity = str(calibration["calibration_id"])
        else:
            identity = waits.calibration_id
            check_calibration(identity, waits.by, tags)
        request = requests.CalibrateFinishRequest(by=by, discard=discard, calibration_id=identity)
        result = await context.rig.ask_for(messages.CalibrationResult, request)
        profile = await asyncio.to_thread(_store, context, code, result, by, identity)
        with contextlib.suppress(ApiError):  # it is stored, whatever the rig says now
            await context.rig.ask(requests.CalibrateStoredRequest(calibration_id=identity))
            await context.rig.fresh_status()
    return {"profile": profile, "recordings": result.recordings}
