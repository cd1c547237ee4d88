"""What is next for a participant: one line and at most one button, from the rig, the calibration, tests and models."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, Literal

from fastapi import APIRouter

from stimrig.api import language
from stimrig.api.language import _, lazy
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store.tables import OPEN_STATES, Participant, Test
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import render, starting
from stimrig.api.web.routes import participants

router = APIRouter(include_in_schema=False)
Kind = Literal[
    "running", "identifying", "look", "asked", "done", "archived", "rearm", "wait", "calibrating", "calibrate", "test",
    "again",
]  # fmt: skip
NO_MODEL = ("stopped", "fault", "refused", "failed")
"""How a test ends that gives no model."""
BEFORE = {
    "poor": lazy("The last model is not usable."),
    "rejected": lazy("The last model was rejected."),
    "stopped": lazy("The last test was stopped."),
    "fault": lazy("The last test ended by a fault."),
    "refused": lazy("The last test was not started."),
    "failed": lazy("The last test gave no model."),
}


@dataclass(frozen=True)
class Today:
    """The newest model of today that nobody has rejected."""

    id: str
    verdict: str
    decided: bool = False


@dataclass(frozen=True)
class Situation:
    """What the next step of a participant depends on; a text is empty where there is nothing of the kind."""

    code: str
    rig: str = "ready"
    """Its state, as the bar shows it."""
    calibration: Literal["none", "valid", "expired"] = "valid"
    may_start: bool = True
    """Whether this rig lets a test begin now as far as the calibration is concerned."""
    holder: str = ""
    """Whose test or calibration the rig is busy with."""
    running: str = ""
    """The participant's own test that is under way."""
    identifying: str = ""
    """Their test whose model is being made."""
    ended: str = ""
    """How today's last test ended where it gave no model: stopped, fault, refused, failed."""
    model: Today | None = None
    rejected: bool = False
    """Today's models have all been rejected."""
    served_until: str = ""
    """Until when the controller has an approved model (time of day)."""
    archived_since: str = ""
    asked: bool = False
    """The trials of the approved model ask for a new test."""


@dataclass(frozen=True)
class Step:
    """The line. `href` empty: the button is a form's own (kind `test`), or there is none (no `button`).

    To the `href` of the kind `archived` a form is sent: it changes something.
    """

    kind: Kind
    words: str
    button: str = ""
    href: str = ""
    subject: str = ""

    @property
    def key(self) -> str:
        """Changes when the line does."""
        return f"{self.kind} {self.subject}".strip()


def next_step(now: Situation) -> Step:
    """The next step."""
    return _under_way(now) or _archived(now) or _model_waits(now) or _rig_waits(now) or _test_waits(now)


def _under_way(now: Situation) -> Step | None:
    place = f"/participants/{now.code}/calibration"
    if now.running:
        words = _("The test is running.")
        return Step("running", words, _("Go to the test"), f"/tests/{now.running}", now.running)
    if now.identifying:
        words = _("The test is done. The model is being made; it takes a few seconds.")
        return Step("identifying", words, _("Go to the test"), f"/tests/{now.identifying}", now.identifying)
    if now.rig == "calibrating" and now.holder == now.code:
        return Step("calibrating", _("The calibration has begun."), _("Go on with the calibration"), place)
    return None


def _archived(now: Situation) -> Step | None:
    """Nothing is begun with a participant in the archive."""
    if not now.archived_since:
        return None
    words = _("In the archive since %(time)s: no test starts.", time=now.archived_since)
    return Step("archived", words, _("Take out of the archive"), f"/participants/{now.code}/unarchive")


def _model_waits(now: Situation) -> Step | None:
    """Look at today's model; done where the controller has one and nothing newer waits."""
    model = now.model
    if model is not None and not model.decided and model.verdict != "not usable":
        words = _("The model is ready. Look at it, then approve or reject it.")
        return Step("look", words, _("Look at the model"), f"/models/{model.id}", model.id)
    if now.served_until and now.asked:
        words = _("The trials say that a new test is needed.")
        return Step("asked", words, _("See why"), f"/participants/{now.code}#trials", now.served_until)
    if now.served_until:
        words = _("Done. The controller has today's model until %(time)s.", time=now.served_until)
        return Step("done", words, _("Back to the participants"), "/", now.served_until)
    return None


def _rig_waits(now: Situation) -> Step | None:
    """What keeps the rig from a test or a calibration."""
    if now.rig in ("latched", "uncertain"):
        words = _("The rig has stopped and needs a re-arm. Look at the participant, then press the button above.")
        return Step("rearm", words, subject=now.rig)
    if now.rig == "disconnected":
        words = _("A device is not connected. See above what to check.")
        return Step("wait", words, subject=now.rig)
    if now.rig in ("unreachable", "silent"):
        words = _("The rig does not answer. A test is possible when it does.")
        return Step("wait", words, subject=now.rig)
    if now.holder and now.holder != now.code:
        words = _("The rig is in use for %(code)s. Wait until it is free.", code=now.holder)
        return Step("wait", words, subject=now.holder)
    return None


def _test_waits(now: Situation) -> Step:
    """Calibrate, then test; with what came of today's last test."""
    before = _before(now)
    if now.calibration != "valid":
        words = _("Calibrate for today: find the pulse widths that are felt, move the arm and are comfortable.")
        if now.calibration == "expired":
            words = _("The last calibration was for another day. Calibrate for today.")
        subject = "may" if now.may_start else ""
        return Step("calibrate", before + words, _("Calibrate"), f"/participants/{now.code}/calibration", subject)
    button = _("Start the pre-session test")
    if before:
        return Step("again", before + _("Test again."), button, subject=now.ended or "again")
    return Step("test", _("Calibrated. Start the pre-session test."), button)


def _before(now: Situation) -> str:
    """What came of the last test where it gave no model to approve; with a space at its end, or empty."""
    came = now.ended
    if now.model is not None and now.model.verdict == "not usable":
        came = "poor"
    elif now.rejected:
        came = "rejected"
    return f"{BEFORE[came]} " if came else ""


# ---- how things stand now -----------------------------------------------------------------------------------------


@router.get("/participants/{code}/next")
async def key(context: Ctx, _who: Tester, code: str) -> dict[str, str]:
    """Whether the line is still the one that the page shows."""
    row = await asyncio.to_thread(participants.find, context, code)
    return {"key": (await asyncio.to_thread(step, context, row)).key}


def step(context: Context, row: Participant) -> Step:
    """The participant's next step now."""
    standing = starting.calibrated(context, row)
    state, current = render.state_of(context), context.runner.current
    opened = context.rig.status.calibration if context.rig.status else None
    holder = current.participant if current else opened.participant if opened else ""
    test = _last_test(context, row.code)
    open_test = test is not None and test.state in OPEN_STATES
    mine = current is not None and test is not None and current.test_id == test.id
    models = context.versions.of(row.code, since_utc=context.clock.start_of_day_utc())
    kept = next(filter(_counts, models), None)
    served = context.versions.approved(row.code)
    now = Situation(
        code=row.code,
        rig=state,
        calibration=standing.state,
        may_start=standing.may_start,
        holder=holder,
        running=test.id if test is not None and mine and not (served and test.kind == SEQUENCE) else "",
        identifying=test.id if test is not None and open_test and not mine else "",
        ended=test.state if test is not None and test.state in NO_MODEL and test.kind != SEQUENCE else "",
        model=Today(kept["id"], kept["verdict"], kept["decision"] == "approved") if kept else None,
        rejected=bool(models) and kept is None,
        served_until=language.until(served.expires_utc or context.clock.end_of_day_utc())[-5:] if served else "",
        archived_since=language.when(row.archived_utc) if row.archived_utc else "",
        asked=served is not None and context.tracked.asks(served.id) is not None,
    )
    return next_step(now)


def _last_test(context: Context, code: str) -> Test | None:
    """The newest test of today."""
    today = (Test.participant == code, Test.requested_utc >= context.clock.start_of_day_utc())
    return context.store.first(Test, *today, order=Test.requested_utc.desc())


def _counts(version: dict[str, Any]) -> bool:
    """Whether a version counts: not a rejected one, nor one in last time's structure where the plain one is better."""
    offered = version["carried_from_id"] is None or (version["carried"] or {}).get("offered") != "plain"
    return version["decision"] == "approved" or (version["decision"] is None and offered)
