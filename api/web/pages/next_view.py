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
    "running", "identifying", "look", "asked", "done", "rearm", "wait", "calibrating", "calibrate", "joint",
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
PROGRESS = {
    "identifying": "The test is done. The model is being made; it takes a few seconds.",
    "sealing": "The test is over. Its recording is being saved.",
}
LAST_MODEL = {"poor": "The last model is not usable. ", "rejected": "The last model was rejected. ", "": ""}
ENDED = {
    "stopped": "was stopped", "fault": "ended by a fault", "refused": "was not started", "failed": "gave no model",
}  # fmt: skip
"""How a test ended that gave nothing."""


@dataclass(frozen=True)
class Step:
    """The line. `href` empty: the button calls REST (`test`, `calibrate`), or there is none."""

    kind: Kind
    words: str
    button: str = ""
    href: str = ""

    @property
    def key(self) -> str:
        """Changes when the line does."""
        return f"{self.kind} {crc32(f'{self.words} {self.button} {self.href}'.encode()):08x}"


def next_step(
    code: str,
    rig: str = "ready",  # its state, as the bar shows it
    current: str = "",  # of every pulse
    calibration: Literal["none", "valid", "expired"] = "valid",
    holder: str = "",  # whose test or calibration the rig is busy with
    test: str = "",  # their newest test of today, or the one that goes on since yesterday
    of: Literal["test", "trial", "joint"] = "test",  # it gives a model, is a controller's, or is of a joint that moves
    state: str = "",  # its state
    undecided: str = "",  # the newest model of today, where it may be approved and nobody has decided on it
    last_model: Literal["", "poor", "rejected"] = "",  # why none of today's models can be approved
    served_until: str = "",  # time of day until which the controller has an approved model
    lacks_key: Literal["", "mine", "another's"] = "",  # no controller has a key for it: whether who looks may make one
    needs_test: bool = False,  # the trials of the approved model ask for a new test
    unstored: bool = False,  # the rig keeps a finished calibration of theirs that the service could not store
) -> Step:
    """Return the next step: what is under way first, then what waits for a person, then what can be begun.

    A text is empty where there is nothing of the kind.
    """
    at, trial = f"/participants/{code}", of == "trial"
    if state in OPEN_STATES:
        kind: Kind = "running" if state in ("requested", "running") else "identifying"
        words = PROGRESS.get(state) or ("The controller plays a trial." if trial else "The test is running.")
        if state != "identifying" and rig in ("unreachable", "silent"):
            words = "A test was running when the rig was last heard of. Its state is not known."
        elif rig == "stopping" and state not in PROGRESS:
            words = "The test is being stopped."
        return Step(kind, words, "Go to the trial" if trial else "Go to the test", f"/tests/{test}")
    if unstored or (rig == "calibrating" and holder == code):
        words = "A calibration waits to be stored." if unstored else "The calibration has begun."
        return Step("calibrating", words, "Go on with the calibration", f"{at}/calibration")
    ended = ENDED.get(state, "") if not trial or state != "failed" else "was not finished"
    ended = ended and f"The last {'trial' if trial else 'test'} {ended}. "
    if undecided:
        words = f"{ended}The model is ready. Look at it, then approve or reject it."
        return Step("look", words, "Look at the model", f"/models/{undecided}")
    served = f"The controller has today's model until {served_until}." if served_until else ""
    if served and lacks_key:
        served = f"Today's model is approved until {served_until}, but no controller has a key yet."
    if advice := RIG_ADVICE.get(rig):
        return Step("rearm" if advice == REARM else "wait", f"{served} {advice}".strip())
    if served and needs_test:
        return Step("asked", "The trials say that a new test is needed.", "See why", f"{at}#trials")
    if served and of != "joint":
        if lacks_key == "mine":
            return Step("done", ended + served, "Make a controller key", f"{at}#keys")
        return Step("done", (ended or ("" if lacks_key else "Done. ")) + served, "Back to the participants", "/")
    if rig in BUSY or holder not in ("", code):
        use = f"in use for {holder}. Wait until it is free." if holder not in ("", code) else ""
        return Step("wait", f"The rig is {use or 'in use. Wait until it is free.'}")
    before = ended if of == "joint" else LAST_MODEL[last_model] or ended
    if calibration != "valid":
        words = "Calibrate for today: find the pulse widths that are felt, move the limb and are comfortable."
        if calibration == "expired":
            words = "The last calibration was for another day. Calibrate for today."
        return Step("calibrate", before + words, f"Begin the calibration: {current}")
    if of == "joint":
        words = "Go on with the tests of the joint, or make the model of them."
        return Step("joint", before + words, "To the tests of the joint", f"{at}/joint")
    if before and of == "test":
        return Step("again", before + "Test again.", "Start the pre-session test")
    return Step("test", before + "Calibrated. Start the pre-session test.", "Start the pre-session test")


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
    status, current, today = context.rig.status, context.runner.current, context.clock.start_of_day_utc()
    opened, unstored = (status.calibration, status.calibrated) if status else (None, None)
    goes_on = or_(Test.requested_utc >= today, Test.state.in_(OPEN_STATES))
    test: Test | None = context.store.first(
        Test, Test.participant == row.code, goes_on, order=Test.requested_utc.desc()
    )
    models, served = context.versions.of(row.code, since_utc=today), context.versions.approved(row.code)
    newest = next(filter(_counts, models), None)
    poor = newest is not None and newest["verdict"] == "not usable"
    of: Literal["test", "trial", "joint"] = "trial" if test and test.kind == SEQUENCE else "test"
    if test and test.kind in KINDS and all(model["created_utc"] < test.requested_utc for model in models):
        of = "joint"  # it is one test among others once there is a model that was made after it
    # a trial of today was played by somebody's own token where there is no key
    keyless = served is not None and of != "trial" and not controllers.has_key(context.auth, row.code)
    return next_step(
        row.code,
        rig=render.state_of(context),
        current=starting.current_words(row),
        calibration=starting.calibrated(context, row).state,
        holder=current.participant if current else opened.participant if opened else "",
        test=test.id if test else "",
        of=of,
        state=context.runner.document(test)["state"] if test else "",
        undecided=newest["id"] if newest and not poor and newest["decision"] is None else "",
        last_model="poor" if poor else "rejected" if models and newest is None else "",
        served_until=local_time.until(served.expires_utc or context.clock.end_of_day_utc())[-5:] if served else "",
        lacks_key="" if not keyless else "mine" if principal.may(Scope.APPROVE_MODEL) else "another's",
        needs_test=served is not None and context.tracked.new_test_reason(served.id) is not None,
        unstored=unstored is not None and unstored.participant == row.code,
    )


def _counts(version: dict[str, Any]) -> bool:
    """Return whether a version counts: not rejected, nor with a carried structure where the plain one is better."""
    offered = version["carried_from_id"] is None or (version["carried"] or {}).get("offered") != "plain"
    return version["decision"] == "approved" or (version["decision"] is None and offered)
