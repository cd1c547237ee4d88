"""What is next for a participant: one line and at most one button, from the state alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from stimrig.api.language import _

Kind = Literal[
    "running", "identifying", "look", "asked", "done", "archived", "rearm", "wait", "calibrating", "calibrate", "test",
    "again",
]  # fmt: skip

NO_MODEL = ("stopped", "fault", "refused", "failed")
"""How a test ends that gives no model."""


@dataclass(frozen=True)
class Today:
    """The newest model of today that nobody has rejected."""

    id: str
    verdict: str
    decided: bool = False


@dataclass(frozen=True)
class Situation:
    """What the next step depends on.

    Parameters
    ----------
    code : str
        The participant.
    rig : str
        The rig's state, as the bar shows it.
    calibration : str
        How today's calibration stands.
    may_start : bool
        Whether this rig lets a test begin now as far as the calibration is concerned.
    holder : str
        Whose test or calibration the rig is busy with; empty where it is free.
    running, identifying : str
        The participant's own test that is under way, or whose model is being made.
    ended : str
        How today's last test ended where it gave no model: stopped, fault, refused, failed.
    model : Today or None
        The newest model of today.
    rejected : bool
        Today's models have all been rejected.
    served_until : str
        Until when the controller has an approved model (time of day); empty where it has none.
    archived_since : str
        Since when the participant is in the archive, as a page shows it; empty where it is not.
    asked : bool
        The trials of the approved model ask for a new test.
    """

    code: str
    rig: str = "ready"
    calibration: Literal["none", "valid", "expired"] = "valid"
    may_start: bool = True
    holder: str = ""
    running: str = ""
    identifying: str = ""
    ended: str = ""
    model: Today | None = None
    rejected: bool = False
    served_until: str = ""
    archived_since: str = ""
    asked: bool = False


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


def of(now: Situation) -> Step:
    """The next step."""
    return _under_way(now) or _of_archive(now) or _of_model(now) or _of_rig(now) or _of_test(now)


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


def _of_archive(now: Situation) -> Step | None:
    """Nothing is begun with a participant in the archive."""
    if not now.archived_since:
        return None
    words = _("In the archive since %(time)s: no test starts.", time=now.archived_since)
    return Step("archived", words, _("Take out of the archive"), f"/participants/{now.code}/unarchive")


def _of_model(now: Situation) -> Step | None:
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


def _of_rig(now: Situation) -> Step | None:
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


def _of_test(now: Situation) -> Step:
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
    words = ""
    if now.model is not None and now.model.verdict == "not usable":
        words = _("The last model is not usable.")
    elif now.rejected:
        words = _("The last model was rejected.")
    elif now.ended:
        words = {
            "stopped": _("The last test was stopped."),
            "fault": _("The last test ended by a fault."),
            "refused": _("The last test was not started."),
        }.get(now.ended, _("The last test gave no model."))
    return f"{words} " if words else ""
