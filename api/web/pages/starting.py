"""The page before a test: a person sees who, how strong and how long; its button starts exactly that plan."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fastapi import APIRouter, Request
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
from stimrig.api.sessions.playing import refuse_archived
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

    Parameters
    ----------
    kind : str
        Of the test.
    target : float, optional
        Of an adaptive test: within how many percent both curves are to be known.
    target_rad : float, optional
        Of a held test: the angle; default: the next that is open.
    model : str
        Of a next experiment: the model whose diagnosis names it.

    Raises
    ------
    ApiError
        409 a test runs, or a calibration is needed first; 422 no such test; what the rig refuses.
    """
    row = await asyncio.to_thread(participants.find, context, code)
    refuse_archived(row)
    context.runner.refuse_second()
    standing = await asyncio.to_thread(calibrated, context, row)
    if not standing.may_start:
        detail = f"{code}'s calibration: {standing.words}. This rig needs a calibration of today before a test."
        raise ApiError(409, "calibrate-first", "Calibrate first", detail)
    labels = {name: request.query_params.get(name, "").strip() or None for name in LABEL_TITLES}
    fields = await asyncio.to_thread(fields_of_kind, context, code, kind, target, target_rad, model)
    body = checked_test(participant=code, kind=kind, **labels, **fields)
    preview = await context.runner.preview(body)
    widest_us, joint = max(preview["pulse_width_us"], default=0.0), preview.get("joint")
    stimulates = widest_us > 0.0
    strength = f"{current_words(row)}, {number(widest_us, 0, 'µs')}"
    return page(
        request,
        "start.html",
        participant=row,
        title=f"Start the {words(body.kind, 'kind')} of {code}?",
        button=f"Start now: {strength if stimulates else 'no stimulation'}",
        rows=[*rows(context, row, preview, standing, principal), *label_rows(vars(body))],
        warnings=[*(warnings(row, standing) if stimulates else []), *out_of_reach(preview)],
        stimulates=stimulates,
        at_deg=allowed_deg(joint) if joint else None,
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


def checked_test(**fields: Any) -> TestIn:
    """Return the request of a test. Raises ApiError (422): in one sentence, what does not hold."""
    try:
        return TestIn.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        raise invalid(f"{' '.join(map(str, first['loc']))}: {first['msg']}. Nothing was started.") from None


def warnings(row: Participant, standing: Calibrated) -> list[str]:
    """Say what deserves a second look."""
    return [] if standing.state == "valid" else [f"{row.code} is not calibrated: {NOBODY}."]


def out_of_reach(preview: dict[str, Any]) -> list[str]:
    """Say that a test which stops itself will probably not reach its target, with what it can."""
    reach = preview.get("reach")
    return [] if reach is None or reach["reachable"] else [reach["words"]]


def rows(
    context: Context, row: Participant, preview: dict[str, Any], standing: Calibrated, principal: Principal
) -> list[Row]:
    """List what a person has to know before pressing the button."""
    widths_us, torque_time = preview["pulse_width_us"], preview.get("torque_time_nms")
    pulses, widest_us = sum(width > 0 for width in widths_us), max(widths_us, default=0.0)
    phase = "charge of one phase" if pulses == 1 else "charge of one phase, all pulses together"
    dose = f"{pulses} pulse{'' if pulses == 1 else 's'}, {dose_words(preview['charge_uc'])} ({phase})"
    if torque_time is not None:
        dose += f", about {number(torque_time, 0, 'N·m·s')} of torque"
    long, more = number(preview["duration_s"], 0, "s"), []
    if joint := preview.get("joint"):
        long, dose, more = joint_rows(joint, row.profile, long, dose)
    elif bounds := preview.get("bounds"):
        reach = preview["reach"]
        long = f"at most {number(bounds['max_duration_s'], 0, 's')}"
        dose = f"at most {number(bounds['max_torque_time_nms'], 0, 'N·m·s')} of torque"
        more = [("Stops once known within", number(preview["target"]["curve_percent"], 1, "%"))]
        more += [("Expected", reach["words"])] if reach["reachable"] else []
    widest = number(row.profile["max_pulse_width_us"], 0, "µs")
    current = [
        ("Side and muscle", site_words(site_of(row))),
        ("Current of every pulse", current_words(row)),
        ("Widest pulse", f"{number(widest_us, 0, 'µs')}, comfort maximum {widest}"),
    ]
    return [
        ("Who", row.code),
        *(current if widest_us > 0.0 else []),
        *more,
        ("How long", long),
        ("Dose", dose),
        ("Stops at", number(row.profile["max_torque_nm"], 1, "N·m")),
        *([("Calibration", standing.words)] if widest_us > 0.0 else []),
        ("Run by", principal.name),
        ("Rig", rig_words(context)),
    ]


def allowed_deg(joint: Mapping[str, Any]) -> tuple[float, float] | None:
    """Angles between which a held test starts, °; None of another one."""
    if joint["target_rad"] is None:
        return None
    middle, half = math.degrees(joint["target_rad"]), math.degrees(joint.get("tolerance_rad", profiles.TOLERANCE_RAD))
    return round(middle - half, 2), round(middle + half, 2)


def joint_rows(
    joint: Mapping[str, Any], profile: Mapping[str, Any], long: str, dose: str
) -> tuple[str, str, list[Row]]:
    """Say how long a guided test of a joint takes, at what dose, and list the rows about the angle."""
    range_words = profiles.range_words(profiles.range_of(profile) or (0, 0))
    more = [("Joint angles", f"{range_words}; beyond them the test stops")]
    if joint["kind"] == HELD:
        more.insert(0, ("Hold at", degrees(joint["target_rad"])))
        expected = joint["doses"]["held_each"]
    else:
        long = f"at most {number(joint['longest_s'], 0, 's')}; ends by itself once enough was seen"
        expected = joint["doses"]["moving"]
    if joint["kind"] == PASSIVE:
        return long, "none: no current flows", more
    if joint["known"]:
        dose = f"about {number(expected, 1, 'N·m·s')} of torque"
    elif joint["doses"]["paper"] > 0:
        percent = number(100 * expected / joint["doses"]["paper"], 0, "%")
        dose = f"about {percent} of the pre-session test's"
    return long, dose, more


def current_words(row: Participant) -> str:
    """Write the current of every pulse."""
    return f"{row.profile['current_ma']:g} mA"


def rig_words(context: Context) -> str:
    """Say what the current comes from."""
    status = context.rig.status
    if status is None or not context.rig.connected:
        return "cannot be reached"
    stimulator = status.stimulator
    parts = [str(stimulator.get("device") or "stimulator unknown").upper(), str(stimulator.get("firmware") or "")]
    described = f"{' '.join(part for part in parts if part)}, {status.state}"
    return f"{described}, emulated: no person is connected" if context.settings.emulated else described
