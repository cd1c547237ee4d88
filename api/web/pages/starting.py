"""The question before stimulation: a person sees who, how strong, how long, and confirms."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, Literal

from api.errors import ApiError
from api.people.auth import Principal
from api.sessions import profiles
from api.sessions.questions import Question, Row
from api.sessions.requests import TestIn
from api.sessions.runner import Seen
from api.store import audit
from api.store.tables import Participant
from api.web.dependencies import Context
from api.web.pages.environment import number, when
from api.web.routes import participants

NOBODY = "today nobody has tested which pulse widths are felt, move the arm and are comfortable"
KINDS = {"pre-session": "pre-session test", "next-experiment": "next experiment"}


@dataclass(frozen=True)
class Calibrated:
    """How a participant's calibration stands, and what that means on this rig."""

    state: Literal["none", "valid", "expired"]
    words: str
    may_start: bool


def calibrated(context: Context, row: Participant) -> Calibrated:
    """Whether a person has found this participant's limits today, who, and whether a test may start without."""
    state = profiles.calibration(row.profile, context.clock.utc())
    if state == "none":
        required = bool(context.rig.status and context.rig.status.require_calibration)
        return Calibrated(state, "not calibrated", not required)
    with context.store.read() as session:
        entry = audit.newest(session, row.code, "finish calibration")
    by = f" by {entry.who}" if entry else ""
    end = "expired" if state == "expired" else "valid until"
    words = f"found on {when(row.profile.get('set_at_utc'))}{by}, {end} {when(row.profile.get('expires_at_utc'))}"
    return Calibrated(state, words, state == "valid")


async def ask(context: Context, who: Principal, body: TestIn, back: str = "") -> str:
    """Ask a person whether this test is to be started; the address of the question.

    Raises
    ------
    ApiError
        409: a test runs, or a calibration is wanted first; what the rig refuses.
    """
    row = await asyncio.to_thread(participants.find, context, body.participant)
    context.runner.refuse_second()
    standing = await asyncio.to_thread(calibrated, context, row)
    if not standing.may_start:
        detail = f"{row.code}'s calibration: {standing.words}. This rig needs a calibration of today before a test."
        raise ApiError(409, "calibrate-first", "Calibrate first", detail)
    seen = Seen(profiles.version(row.profile), await context.runner.preview(body))

    async def action() -> str:
        test = await context.runner.start(body, who.name, seen)
        return f"/tests/{test.id}"

    strength = f"{row.profile['current_ma']:g} mA, {number(widest_us(seen.preview), 0, 'µs')}"
    question = Question(
        participant=row.code,
        title=f"Start the {KINDS.get(body.kind, body.kind)} of {row.code}?",
        button=f"Start now: {strength}",
        action=action,
        rows=rows(row, seen.preview, standing, rig_words(context)),
        warnings=[] if standing.state == "valid" else [f"{row.code} is not calibrated: {NOBODY}."],
        stimulates=True,
        back=back,
    )
    return context.questions.ask(question, who)


def rows(row: Participant, preview: dict[str, Any], standing: Calibrated, rig: str) -> list[Row]:
    """What a person has to know before saying yes."""
    pulses = sum(width > 0 for width in preview["pulse_width_us"])
    torque_time = preview.get("torque_time_nms")
    effort = "" if torque_time is None else f", about {number(torque_time, 0, 'N·m·s')} of torque"
    profile = row.profile
    return [
        Row("Who", row.code),
        Row("Current of every pulse", f"{profile['current_ma']:g} mA"),
        Row("Widest pulse", f"{number(widest_us(preview), 0, 'µs')}, comfort maximum "
                            f"{number(profile['max_pulse_width_us'], 0, 'µs')}"),
        Row("How long", number(preview["duration_s"], 0, "s")),
        Row("Dose", f"{pulses} pulses, {number(preview['charge_uc'] / 1000, 2, 'mC')}{effort}"),
        Row("Stops at", number(profile["max_torque_nm"], 1, "N·m")),
        Row("Calibration", standing.words),
        Row("Rig", rig),
    ]  # fmt: skip


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
    emulated = ", emulated: no person is connected" if context.settings.emulated else ""
    return f"{' '.join(part for part in parts if part)}, {status.state}{emulated}"
