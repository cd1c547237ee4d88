"""What every page says of the rig: one source for the bar, the notice and the rig's card, with scripts and without."""

from __future__ import annotations

import hashlib
from typing import Any

from api.people.auth import Principal
from api.web.dependencies import Context
from api.web.pages.environment import clock

SILENT_S = 1.6
"""The service asks the rig once a second and hears its torque more often: after such a silence nothing is known."""
TORQUE_OLD_S = 1.0
"""An older torque is not shown as the present one."""

WORDS: dict[str, tuple[str, str]] = {
    "ready": ("No stimulation", "ready"),
    "calibrating": ("No stimulation", "a calibration is open"),
    "arming": ("Stimulating", "begins"),
    "running": ("Stimulating", ""),
    "stopping": ("Stopping", "not confirmed yet"),
    "sealing": ("No stimulation", "saving the recording"),
    "latched": ("Stopped", "waits for a person"),
    "uncertain": ("Restarted", "waits for a person"),
    "disconnected": ("Disconnected", "see what to mend"),
    "unreachable": ("Not known", "the rig cannot be reached"),
    "silent": ("Not known", "the rig does not answer"),
}
"""What flows, and what else there is to say, for each state of the rig and of the way to it."""


def state_of(context: Context) -> str:
    """The rig's state as far as it is known now."""
    rig = context.rig
    if not rig.connected or rig.status is None:
        return "unreachable"
    if rig.age_s is None or not (rig.age_s <= SILENT_S):
        return "silent"
    return rig.status.state


def torque_now(context: Context) -> tuple[float | None, float | None]:
    """The newest torque (N·m) and its age (s); no torque where it is old or no number, no age where none ever came."""
    torque_nm, age_s = context.runner.hub.torque()
    status = context.rig.status
    known = status is not None and status.torque_nm is not None and age_s is not None and age_s <= TORQUE_OLD_S
    return (torque_nm if known else None), age_s


def now(context: Context, principal: Principal | None) -> dict[str, Any]:
    """What the rig does now. Who is not signed in learns the state and nothing of any participant."""
    state = state_of(context)
    flow, more = WORDS[state]
    torque_nm, age_s = torque_now(context)
    told: dict[str, Any] = {
        "state": state,
        "flow": flow,
        "more": more,
        "at": clock(context.clock.utc()),
        "emulated": context.settings.emulated,
        "ready": state == "ready",
    }
    if principal is None:
        return told
    current = context.runner.current
    return {
        **told,
        "torque_nm": torque_nm,
        "torque_age_s": age_s,
        "test": {"id": current.test_id, "participant": current.participant} if current else None,
        "notice": notice_key(context, state),
    }


def notice_key(context: Context, state: str) -> str:
    """Changes whenever the notice has something else to say."""
    reason = context.rig.status.reason if context.rig.status else ""
    return hashlib.sha256(f"{state} {reason}".encode()).hexdigest()[:12]


def mend(reason: str) -> str:
    """What a person should look at before pressing *Reconnect*."""
    if reason.startswith(("load cell", "load_cell")):
        return "Check the load cell's cable and supply, then press Reconnect."
    if reason.startswith("stimulator"):
        return "Check the stimulator's cable, and that it is switched on; then press Reconnect."
    return "Check the cables and supplies of stimulator and load cell, then press Reconnect."
