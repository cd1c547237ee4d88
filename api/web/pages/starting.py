"""The page before a test: a person sees who, how strong and how long; its button starts exactly that plan."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass
from typing import Any, Literal

from fastapi import APIRouter, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import ValidationError

from stimrig.api.clinical_words import degrees, label_rows, words
from stimrig.api.errors import ApiError, invalid
from stimrig.api.local_time import until, when
from stimrig.api.models.changes import dose_words
from stimrig.api.models.places import site_of
from stimrig.api.people.auth import Principal
from stimrig.api.services import participants
from stimrig.api.sessions import profiles
from stimrig.api.sessions.joint_plan import HELD, KINDS, PASSIVE
from stimrig.api.sessions.previews import VALID_S
from stimrig.api.sessions.requests import TestIn
from stimrig.api.store.tables import AuditEntry, Participant
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages.environment import number, site_words
from stimrig.api.web.pages.render import page
from stimrig.rig.messages import LABEL_TITLES

router = APIRouter(include_in_schema=False)
NOBODY = "today nobody has tested which pulse widths are felt, move the limb and are comfortable"
PRE_SESSION, ADAPTIVE, NEXT_EXPERIMENT = "pre-session", "adaptive", "next-experiment"
Row = tuple[str, str]
"""A line of what is about to happen: what, and its value."""


@dataclass(frozen=True)
class Calibrated:
    """How a participant's calibration stands, and what that means on this rig."""

    state: Literal["none", "valid", "expired"]
    words: str
    may_start: bool


def calibrated(context: Context, row: Participant) -> Calibrated:
    """Say whether this participant's limits were found today, by whom, and whether a test may start without."""
    profile = row.profile
    state = profiles.calibration(profile, context.clock.utc())
    if state == "none":
        required = bool(context.rig.status and context.rig.status.require_calibration)
        return Calibrated(state, "not calibrated", not required)
    conditions = AuditEntry.subject == row.code, AuditEntry.action == "finish calibration"
    entry = context.store.first(AuditEntry, *conditions, order=AuditEntry.seq.desc())
    time, end = when(profile.get("set_at_utc")), until(profile.get("expires_at_utc"))
    ends = f"expired {end}" if state == "expired" else f"valid until {end}"
    return Calibrated(state, f"found on {time} by {entry.who if entry else '–'}, {ends}", state == "valid")


@router.get("/participants/{code}/start")
async def start(
    request: Request, context: Ctx, principal: Tester, code: str, kind: str = PRE_SESSION, target: float | None = None,
    target_rad: float | None = None, model: str = "",
) -> Response:  # fmt: skip
    """Preview the test that the address names, and offer to start it.

    `target`: of an adaptive test: within how many percent both curves are to be known. `target_rad`: of a held test:
    the angle; default: the next that is open. `model`: of a next experiment: whose diagnosis names it.

    Raises ApiError: 409 a test runs, or a calibration is needed first; 422 no such test; what the rig refuses.
    """
    row = await asyncio.to_thread(participants.find, context, code)
    context.runner.refuse_second()
    standing = await asyncio.to_thread(calibrated, context, row)
    if not standing.may_start:
        detail = f"{code}'s calibration: {standing.words}. This rig needs a calibration of today before a test."
        raise ApiError(409, "calibrate-first", "Calibrate first", detail)
    labels = {name: request.query_params.get(name, "").strip() or None for name in LABEL_TITLES}
    fields = await asyncio.to_thread(fields_of_kind, context, code, kind, target, target_rad, model)
    try:
        body = TestIn.model_validate({"participant": code, "kind": kind, **labels, **fields})
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from None
    preview = await context.runner.preview(body)
    joint, reach = preview.get("joint"), preview.get("reach")
    widest_us = max(preview["pulse_width_us"], default=0.0)
    current, warnings = current_words(row), []
    if widest_us > 0.0 and standing.state != "valid":
        warnings.append(f"{code} is not calibrated: {NOBODY}.")
    if reach and not reach["reachable"]:
        warnings.append(reach["words"])
    return page(
        request,
        "start.html",
        participant=row,
        title=f"Start the {words(body.kind, 'kind')} of {code}?",
        button=f"Start now: {f'{current}, {widest_us:.0f} µs' if widest_us > 0.0 else 'no stimulation'}",
        rows=[*rows(context, row, preview, standing, principal), *label_rows(vars(body))],
        warnings=warnings,
        stimulates=widest_us > 0.0,
        at_deg=allowed_deg(joint["target_rad"]) if joint else None,
        plan_hash=preview["plan_hash"],
        minutes=VALID_S / 60,
        back=f"/models/{model}" if model else f"/participants/{code}{'/joint' if joint else ''}",
    )


def fields_of_kind(
    context: Context, code: str, kind: str, target: float | None, target_rad: float | None, model_id: str
) -> dict[str, Any]:
    """Return what a test of this kind is asked with. Raises ApiError: 404, 409 or 422 there is no such test."""
    if kind == ADAPTIVE and target is not None:  # shown whether or not its target is in reach
        return {"target": {"curve_percent": target, "step_percent": target}, "anyway": True}
    if kind == HELD and target_rad is not None:
        return {"angle": {"target_rad": target_rad}}
    if kind == NEXT_EXPERIMENT:
        model = context.versions.get(model_id)
        experiment = (context.analyses.known_diagnosis(model) or {}).get("experiment")
        if not experiment or model.participant != code:
            detail = "The diagnosis of this recording names none: no effects need to be told apart."
            raise ApiError(409, "no-experiment", "There is no next experiment", detail)
        chosen = {key: experiment[key] for key in ("segments", "pulse_rate_hz") if key in experiment}
        return {"joins": model.id, **chosen}
    if kind not in (PRE_SESSION, ADAPTIVE, *KINDS):
        raise invalid(f"kind: {kind[:40]!r} is no test that a page starts. Nothing was started.")
    return {}


def rows(
    context: Context, row: Participant, preview: dict[str, Any], standing: Calibrated, principal: Principal
) -> list[Row]:
    """List what a person has to know before pressing the button."""
    profile, widest_us = row.profile, max(preview["pulse_width_us"], default=0.0)
    if "joint" in preview:
        long, dose, more = joint_words(preview, profile)
    elif "bounds" in preview:
        long, dose, more = adaptive_words(preview)
    else:
        long, dose, more = f"{preview['duration_s']:.0f} s", dose_of(preview), []
    widest = f"{widest_us:.0f} µs, comfort maximum {profile['max_pulse_width_us']:.0f} µs"
    current = [
        ("Side and muscle", site_words(site_of(row))),
        ("Current of every pulse", current_words(row)),
        ("Widest pulse", widest),
    ]
    return [
        ("Who", row.code),
        *(current if widest_us > 0.0 else []),
        *more,
        ("How long", long),
        ("Dose", dose),
        ("Stops at", f"{profile['max_torque_nm']:.1f} N·m"),
        *([("Calibration", standing.words)] if widest_us > 0.0 else []),
        ("Run by", principal.name),
        ("Rig", rig_words(context)),
    ]


def dose_of(preview: dict[str, Any]) -> str:
    """Write pulses, charge, and torque where a model expects some."""
    pulses, torque_time = sum(width > 0 for width in preview["pulse_width_us"]), preview["torque_time_nms"]
    phase = "charge of one phase" if pulses == 1 else "charge of one phase, all pulses together"
    dose = f"{pulses} pulse{'' if pulses == 1 else 's'}, {dose_words(preview['charge_uc'])} ({phase})"
    return dose if torque_time is None else f"{dose}, about {torque_time:.0f} N·m·s of torque"


def adaptive_words(preview: dict[str, Any]) -> tuple[str, str, list[Row]]:
    """Say how long a test takes that stops itself, at what dose, and what it is expected to reach."""
    bounds, reach = preview["bounds"], preview["reach"]
    more = [("Stops once known within", f"{preview['target']['curve_percent']:.1f} %")]
    more += [("Expected", reach["words"])] if reach["reachable"] else []
    dose = f"at most {bounds['max_torque_time_nms']:.0f} N·m·s of torque"
    return f"at most {bounds['max_duration_s']:.0f} s", dose, more


def joint_words(preview: dict[str, Any], profile: dict[str, Any]) -> tuple[str, str, list[Row]]:
    """Say how long a guided test of a joint takes, at what dose, and list the rows about the angle."""
    joint, doses, dose = preview["joint"], preview["joint"]["doses"], dose_of(preview)
    range_words = profiles.range_words(profiles.range_of(profile) or (0, 0))
    more, expected = [("Joint angles", f"{range_words}; beyond them the test stops")], doses["moving"]
    long = f"at most {number(joint['longest_s'], 0, 's')}; ends by itself once enough was seen"
    if joint["kind"] == HELD:
        more.insert(0, ("Hold at", degrees(joint["target_rad"])))
        long, expected = f"{preview['duration_s']:.0f} s", doses["held_each"]
    if joint["kind"] == PASSIVE:
        dose = "none: no current flows"
    elif joint["known"]:
        dose = f"about {expected:.1f} N·m·s of torque"
    elif doses["paper"] > 0:
        dose = f"about {100 * expected / doses['paper']:.0f} % of the pre-session test's"
    return long, dose, more


def allowed_deg(target_rad: float | None) -> tuple[float, float] | None:
    """Angles between which a held test starts, °; None of another one."""
    if target_rad is None:
        return None
    middle, half = math.degrees(target_rad), math.degrees(profiles.TOLERANCE_RAD)
    return round(middle - half, 2), round(middle + half, 2)


def current_words(row: Participant) -> str:
    """Write the current of every pulse."""
    return f"{row.profile['current_ma']:g} mA"


def rig_words(context: Context) -> str:
    """Say what the current comes from."""
    status = context.rig.status
    if status is None or not context.rig.connected:
        return "cannot be reached"
    device, firmware = (str(status.stimulator.get(name) or "") for name in ("device", "firmware"))
    described = f"{device.upper() or 'STIMULATOR UNKNOWN'} {firmware}".strip()
    emulated = ", emulated: no person is connected" if context.settings.emulated else ""
    return f"{described}, {status.state}{emulated}"
