"""The question before stimulation: a person sees who, how strong, how long, and confirms."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from stimrig.api.clinical_words import degrees, label_rows, words
from stimrig.api.errors import ApiError
from stimrig.api.local_time import until, when
from stimrig.api.models.changes import dose_words
from stimrig.api.models.places import Site, site_of
from stimrig.api.people.auth import Principal
from stimrig.api.services import participants
from stimrig.api.sessions import profiles
from stimrig.api.sessions.joint_plan import HELD, PASSIVE
from stimrig.api.sessions.playing import other_than, refuse_archived
from stimrig.api.sessions.questions import Question, Row
from stimrig.api.sessions.requests import TestIn
from stimrig.api.store.tables import AuditEntry, Participant
from stimrig.api.web.dependencies import Context
from stimrig.api.web.pages.environment import environment, number

NOBODY = "today nobody has tested which pulse widths are felt, move the limb and are comfortable"


@dataclass(frozen=True)
class Calibrated:
    """How a participant's calibration stands, and what that means on this rig."""

    state: Literal["none", "valid", "expired"]
    words: str
    may_start: bool


def calibrated(context: Context, row: Participant) -> Calibrated:
    """Whether a person has found this participant's limits today, who, and whether a test may start without."""
    profile = row.profile
    state = profiles.calibration(profile, context.clock.utc())
    if state == "none":
        required = bool(context.rig.status and context.rig.status.require_calibration)
        return Calibrated(state, "not calibrated", not required)
    own = AuditEntry.subject == row.code, AuditEntry.action == "finish calibration"
    entry = context.store.first(AuditEntry, *own, order=AuditEntry.seq.desc())
    said = {"time": when(profile.get("set_at_utc")), "end": until(profile.get("expires_at_utc"))}
    said["name"] = entry.who if entry else "–"
    if state == "expired":
        words = "found on {time} by {name}, expired {end}".format(**said)
    else:
        words = "found on {time} by {name}, valid until {end}".format(**said)
    return Calibrated(state, words, state == "valid")


async def ask(context: Context, who: Principal, body: TestIn, back: str = "") -> str:
    """Ask a person whether this test is to be started; the address of the question.

    Raises ApiError: 409 a test runs, or a calibration is wanted first; what the rig refuses.
    """
    row = await asyncio.to_thread(participants.find, context, body.participant)
    refuse_archived(row)
    context.runner.refuse_second()
    standing = await asyncio.to_thread(calibrated, context, row)
    if not standing.may_start:
        detail = f"{row.code}'s calibration: {standing.words}. This rig needs a calibration of today before a test."
        raise ApiError(409, "calibrate-first", "Calibrate first", detail)
    preview = await context.runner.preview(body)

    async def action() -> str:
        test = await context.runner.start(body, who.name, preview, who.token_hash)
        return f"/tests/{test.id}"

    strength = f"{current_words(row)}, {number(widest_us(preview), 0, 'µs')}"
    stimulates = widest_us(preview) > 0.0
    joint = preview.get("joint")
    question = Question(
        participant=row.code,
        title=f"Start the {words(body.kind, 'kind')} of {row.code}?",
        button=f"Start now: {strength}" if stimulates else "Start now: no stimulation",
        action=action,
        rows=rows(row, preview, standing, other_than(who.name, body.ran_by) or who.name, rig_words(context))
        + [Row(*said) for said in label_rows(vars(body))],
        warnings=[*(warnings(row, standing) if stimulates else []), *out_of_reach(preview)],
        stimulates=stimulates,
        back=back,
        at_deg=allowed_deg(joint) if joint else None,
    )
    return context.questions.ask(question, who)


def warnings(row: Participant, standing: Calibrated) -> list[str]:
    """What deserves a second look."""
    if standing.state == "valid":
        return []
    return [f"{row.code} is not calibrated: {NOBODY}."]


def out_of_reach(preview: dict[str, Any]) -> list[str]:
    """That a test which stops itself will probably not reach its target, with what it can."""
    reach = preview.get("reach")
    return [] if reach is None or reach["reachable"] else [reach["words"]]


def rows(row: Participant, preview: dict[str, Any], standing: Calibrated, ran_by: str, rig: str) -> list[Row]:
    """What a person has to know before saying yes."""
    pulses = sum(width > 0 for width in preview["pulse_width_us"])
    torque_time = preview.get("torque_time_nms")
    charge = dose_words(preview["charge_uc"])
    dose = f"{pulses} pulses, {charge} (charge of one phase, all pulses together)"
    if pulses == 1:
        dose = f"1 pulse, {charge} (charge of one phase)"
    if torque_time is not None:
        dose += f", about {number(torque_time, 0, 'N·m·s')} of torque"
    long = number(preview["duration_s"], 0, "s")
    more = []
    if joint := preview.get("joint"):
        long, dose, more = joint_rows(joint, row.profile, long, dose)
    elif bounds := preview.get("bounds"):
        reach, most = preview["reach"], number(bounds["max_torque_time_nms"], 0, "N·m·s")
        long = f"at most {number(bounds['max_duration_s'], 0, 's')}"
        dose = f"at most {most} of torque"
        more = [Row("Stops once known within", number(preview["target"]["curve_percent"], 1, "%"))]
        more += [Row("Expected", reach["words"])] if reach["reachable"] else []
    widest, most = number(widest_us(preview), 0, "µs"), number(row.profile["max_pulse_width_us"], 0, "µs")
    current = [
        Row("Side and muscle", site_words(site_of(row))),
        Row("Current of every pulse", current_words(row)),
        Row("Widest pulse", f"{widest}, comfort maximum {most}"),
    ]
    stimulates = widest_us(preview) > 0.0
    return [
        Row("Who", row.code),
        *(current if stimulates else []),
        *more,
        Row("How long", long),
        Row("Dose", dose),
        Row("Stops at", number(row.profile["max_torque_nm"], 1, "N·m")),
        *([Row("Calibration", standing.words)] if stimulates else []),
        Row("Run by", ran_by),
        Row("Rig", rig),
    ]


def allowed_deg(joint: Mapping[str, Any]) -> tuple[float, float] | None:
    """Between which angles a held test starts, °; None of another one."""
    if joint["target_rad"] is None:
        return None
    middle, half = math.degrees(joint["target_rad"]), math.degrees(joint.get("tolerance_rad", profiles.TOLERANCE_RAD))
    return round(middle - half, 2), round(middle + half, 2)


def joint_rows(
    joint: Mapping[str, Any], profile: Mapping[str, Any], long: str, dose: str
) -> tuple[str, str, list[Row]]:
    """How long a guided test of a joint takes, at what dose, and the rows about the angle."""
    range_rad = profiles.range_of(profile)
    more = [
        Row(
            "Joint angles",
            f"{profiles.range_words(range_rad or (0, 0))}; beyond them the test stops",
        )
    ]
    if joint["kind"] == HELD:
        more.insert(0, Row("Hold at", degrees(joint["target_rad"])))
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


def site_words(site: Site) -> str:
    """A site as a person says it: left, biceps brachii, A. Muscles keep their Latin names."""
    sides = {"left": "left", "right": "right"}
    return ", ".join(part for part in (sides.get(site[0] or ""), *site[1:]) if part) or "not said"


environment.globals |= {"site_words": site_words, "site_of": site_of}


def current_words(row: Participant) -> str:
    """The current of every pulse."""
    return f"{row.profile['current_ma']:g} mA"


def widest_us(preview: dict[str, Any]) -> float:
    """Width of the widest pulse of a plan, µs."""
    return max(preview["pulse_width_us"], default=0.0)


def rig_words(context: Context) -> str:
    """What the current comes from."""
    status = context.rig.status
    if status is None or not context.rig.connected:
        return "cannot be reached"
    stimulator = status.stimulator
    parts = [str(stimulator.get("device") or "stimulator unknown").upper(), str(stimulator.get("firmware") or "")]
    words = f"{' '.join(part for part in parts if part)}, {status.state}"
    return f"{words}, emulated: no person is connected" if context.settings.emulated else words
