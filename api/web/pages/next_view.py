"""What is next for a participant: one line and at most one button, from the rig, the calibration, tests and models."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, Literal
from zlib import crc32

from fastapi import APIRouter
from sqlalchemy import or_

from stimrig.api import local_time
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services import participants
from stimrig.api.sessions import controllers
from stimrig.api.sessions.joint_plan import KINDS
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store.tables import OPEN_STATES, Participant, Test
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import render, starting

router = APIRouter(include_in_schema=False)
Kind = Literal[
    "running", "identifying", "look", "asked", "done", "archived", "rearm", "wait", "calibrating", "calibrate", "joint",
    "test", "again",
]  # fmt: skip
BUSY = ("arming", "running", "stopping", "sealing", "calibrating", render.PASSIVE)
"""States in which the rig plays something, or lets go of it."""
REARM = "The rig has stopped and needs a re-arm. Look at the participant, then press the button above."
SILENT = "The rig does not answer. A test is possible when it does."
RIG_ADVICE = {
    "latched": REARM, "uncertain": REARM, "unreachable": SILENT, "silent": SILENT,
    "disconnected": "A device is not connected. See above what to check.",
}  # fmt: skip
"""Advice on a rig that plays nothing, by its state."""
BEFORE = {
    "poor": "The last model is not usable.",
    "rejected": "The last model was rejected.",
    "stopped": "The last test was stopped.",
    "fault": "The last test ended by a fault.",
    "refused": "The last test was not started.",
    "failed": "The last test gave no model.",
}
TRIAL_BEFORE = {
    "stopped": "The last trial was stopped.",
    "fault": "The last trial ended by a fault.",
    "refused": "The last trial was not started.",
    "failed": "The last trial was not finished.",
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
    current: str = ""
    """Of every pulse."""
    calibration: Literal["none", "valid", "expired"] = "valid"
    holder: str = ""
    """Whose test or calibration the rig is busy with."""
    test: str = ""
    """Their newest test of today, or the one that goes on since yesterday."""
    of: Literal["test", "trial", "joint"] = "test"
    """What kind of test it is: one that gives a model, a controller's trial, one of a joint that moves."""
    state: str = ""
    """Its state."""
    model: Today | None = None
    rejected: bool = False
    """Today's models have all been rejected."""
    served_until: str = ""
    """Until when the controller has an approved model (time of day)."""
    lacks_key: Literal["", "mine", "another's"] = ""
    """No controller has a key for that model: whether who looks may make one."""
    archived_since: str = ""
    needs_test: bool = False
    """The trials of the approved model ask for a new test."""
    unstored: bool = False
    """The rig keeps a finished calibration of theirs that the service could not store."""


@dataclass(frozen=True)
class Step:
    """The line. `href` empty: the button calls REST (`test`, `calibrate`, `archived`), or there is none."""

    kind: Kind
    words: str
    button: str = ""
    href: str = ""

    @property
    def key(self) -> str:
        """Changes when the line does."""
        checksum = crc32(f"{self.words} {self.button} {self.href}".encode())
        return f"{self.kind} {checksum:08x}"


def next_step(now: Situation) -> Step:
    """The next step."""
    rules = (_under_way, _archived, _model_waits, _rig_stands, _served, _rig_is_busy)
    return next(filter(None, (rule(now) for rule in rules)), None) or _test_waits(now)


def _under_way(now: Situation) -> Step | None:
    """Their test, or their calibration."""
    if now.state in OPEN_STATES:
        button = "Go to the trial" if now.of == "trial" else "Go to the test"
        kind: Kind = "running" if now.state in ("requested", "running") else "identifying"
        return Step(kind, _playing(now), button, f"/tests/{now.test}")
    if now.unstored or (now.rig == "calibrating" and now.holder == now.code):
        words = "A calibration waits to be stored." if now.unstored else "The calibration has begun."
        return Step("calibrating", words, "Go on with the calibration", f"/participants/{now.code}/calibration")
    return None


def _playing(now: Situation) -> str:
    """Describe the open test's progress."""
    if now.state == "identifying":
        return "The test is done. The model is being made; it takes a few seconds."
    if now.rig in ("unreachable", "silent"):
        return "A test was running when the rig was last heard of. Its state is not known."
    if now.state == "sealing":
        return "The test is over. Its recording is being saved."
    if now.rig == "stopping":
        return "The test is being stopped."
    return "The controller plays a trial." if now.of == "trial" else "The test is running."


def _archived(now: Situation) -> Step | None:
    """Nothing is begun with a participant in the archive."""
    if not now.archived_since:
        return None
    words = f"In the archive since {now.archived_since}: no test starts."
    return Step("archived", words, "Take out of the archive")


def _model_waits(now: Situation) -> Step | None:
    """Look at today's model; what became of a test after it is said first."""
    model = now.model
    if model is None or model.decided or model.verdict == "not usable":
        return None
    words = "The model is ready. Look at it, then approve or reject it."
    return Step("look", _ended(now) + words, "Look at the model", f"/models/{model.id}")


def _rig_stands(now: Situation) -> Step | None:
    """Wait for the rig, or re-arm it, while it plays nothing."""
    words = RIG_ADVICE.get(now.rig)
    has = f"{_has_model(now)} " if now.served_until else ""
    kind: Kind = "rearm" if now.rig in ("latched", "uncertain") else "wait"
    return None if words is None else Step(kind, f"{has}{words}")


def _served(now: Situation) -> Step | None:
    """Done where the controller has a model, unless its trials, or tests of the joint, ask for more."""
    if now.served_until and now.needs_test:
        words = "The trials say that a new test is needed."
        return Step("asked", words, "See why", f"/participants/{now.code}#trials")
    if now.of == "joint":
        return None
    if now.served_until:
        words = f"{_ended(now) or ('' if now.lacks_key else 'Done.' + ' ')}{_has_model(now)}"
        if now.lacks_key == "mine":
            return Step("done", words, "Make a controller key", f"/participants/{now.code}#keys")
        return Step("done", words, "Back to the participants", "/")
    return None


def _has_model(now: Situation) -> str:
    if now.lacks_key:
        return f"Today's model is approved until {now.served_until}, but no controller has a key yet."
    return f"The controller has today's model until {now.served_until}."


def _rig_is_busy(now: Situation) -> Step | None:
    if now.holder and now.holder != now.code:
        words = f"The rig is in use for {now.holder}. Wait until it is free."
        return Step("wait", words)
    if now.rig in BUSY:
        return Step("wait", "The rig is in use. Wait until it is free.")
    return None


def _test_waits(now: Situation) -> Step:
    """Calibrate, then test; with what came of today's last test."""
    before = _before(now)
    if now.calibration != "valid":
        words = "Calibrate for today: find the pulse widths that are felt, move the limb and are comfortable."
        if now.calibration == "expired":
            words = "The last calibration was for another day. Calibrate for today."
        button = f"Begin the calibration: {now.current}"
        return Step("calibrate", before + words, button)
    if now.of == "joint":
        words = "Go on with the tests of the joint, or make the model of them."
        return Step("joint", before + words, "To the tests of the joint", f"/participants/{now.code}/joint")
    button = "Start the pre-session test"
    if before and now.of == "test":
        return Step("again", before + "Test again.", button)
    return Step("test", before + "Calibrated. Start the pre-session test.", button)


def _before(now: Situation) -> str:
    """Describe the last test if it gave no model to approve; ends with a space, or empty."""
    if now.of != "joint" and now.model is not None and now.model.verdict == "not usable":
        return f"{BEFORE['poor']} "
    return f"{BEFORE['rejected']} " if now.of != "joint" and now.rejected else _ended(now)


def _ended(now: Situation) -> str:
    """Describe how the newest test ended if it gave nothing; ends with a space, or empty."""
    words = (TRIAL_BEFORE if now.of == "trial" else BEFORE).get(now.state)
    return f"{words} " if words else ""


# ---- how things stand now -----------------------------------------------------------------------------------------


@router.get("/participants/{code}/next")
async def key(context: Ctx, principal: Tester, code: str) -> dict[str, str]:
    """Return what changes when the line, or the card of the trials, is another one."""

    def read() -> dict[str, str]:
        row = participants.find(context, code)
        return {"key": step(context, row, principal).key, "trials": trials_key(context, code)}

    return await asyncio.to_thread(read)


def trials_key(context: Context, code: str) -> str:
    """Return what changes with each trial that is followed; empty where none may be."""
    approval = context.tracked.allowing(code)
    return f"{approval.id} {len(context.tracked.rows(approval.id))}" if approval else ""


def step(context: Context, row: Participant, principal: Principal) -> Step:
    """The participant's next step now, for who looks."""
    state, current = render.state_of(context), context.runner.current
    opened = context.rig.status.calibration if context.rig.status else None
    holder = current.participant if current else opened.participant if opened else ""
    test = _last_test(context, row.code)
    kept_by_rig = context.rig.status.calibrated if context.rig.status else None
    models = context.versions.of(row.code, since_utc=context.clock.start_of_day_utc())
    newest = next(filter(_counts, models), None)
    served = context.versions.approved(row.code)
    of = _kind_of(test, models)  # a trial of today was played by somebody's own token where there is no key
    keyless = served is not None and of != "trial" and not controllers.has_key(context.auth, row.code)
    now = Situation(
        code=row.code,
        rig=state,
        current=starting.current_words(row),
        calibration=starting.calibrated(context, row).state,
        holder=holder,
        test=test.id if test else "",
        of=of,
        state=context.runner.document(test)["state"] if test else "",
        model=Today(newest["id"], newest["verdict"], newest["decision"] == "approved") if newest else None,
        rejected=bool(models) and newest is None,
        served_until=local_time.until(served.expires_utc or context.clock.end_of_day_utc())[-5:] if served else "",
        lacks_key="" if not keyless else "mine" if principal.may(Scope.APPROVE_MODEL) else "another's",
        archived_since=local_time.when(row.archived_utc) if row.archived_utc else "",
        needs_test=served is not None and context.tracked.new_test_reason(served.id) is not None,
        unstored=kept_by_rig is not None and kept_by_rig.participant == row.code,
    )
    return next_step(now)


def _last_test(context: Context, code: str) -> Test | None:
    """The newest test of today, or one that goes on."""
    since = or_(Test.requested_utc >= context.clock.start_of_day_utc(), Test.state.in_(OPEN_STATES))
    return context.store.first(Test, Test.participant == code, since, order=Test.requested_utc.desc())


def _kind_of(test: Test | None, models: list[dict[str, Any]]) -> Literal["test", "trial", "joint"]:
    """A test of the joint is one among others once there is a model that was made after it."""
    if test is None or test.kind not in (SEQUENCE, *KINDS):
        return "test"
    if test.kind == SEQUENCE:
        return "trial"
    return "joint" if all(model["created_utc"] < test.requested_utc for model in models) else "test"


def _counts(version: dict[str, Any]) -> bool:
    """Return whether a version counts: not rejected, nor with a carried structure where the plain one is better."""
    offered = version["carried_from_id"] is None or (version["carried"] or {}).get("offered") != "plain"
    return version["decision"] == "approved" or (version["decision"] is None and offered)
