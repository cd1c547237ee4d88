"""What every page shows of the rig: one source for the bar, the notice and the rig's card."""

from __future__ import annotations

import hashlib
import math
from typing import Any

from stimrig.api.language import clock, lazy
from stimrig.api.people.auth import Principal
from stimrig.api.sessions.joint_plan import PASSIVE
from stimrig.api.web.dependencies import Context

SILENT_S = 1.6
"""The rig answers once a second and sends its torque more often. After such a silence its state is unknown."""
TORQUE_OLD_S = 1.0
"""An older torque is not shown as the torque of now."""

WORDS: dict[str, tuple[Any, Any]] = {
    "ready": (lazy("No stimulation"), lazy("ready")),
    "calibrating": (lazy("No stimulation"), lazy("a calibration is open")),
    "arming": (lazy("Stimulating"), lazy("begins")),
    "running": (lazy("Stimulating"), ""),
    PASSIVE: (lazy("No stimulation"), lazy("passive movement")),
    "stopping": (lazy("Stopping"), lazy("not confirmed yet")),
    "sealing": (lazy("No stimulation"), lazy("saving the recording")),
    "latched": (lazy("Stopped"), lazy("needs re-arm")),
    "uncertain": (lazy("Restarted"), lazy("needs re-arm")),
    "disconnected": (lazy("Disconnected"), lazy("see below what to check")),
    "unreachable": (lazy("Unknown"), lazy("the rig cannot be reached")),
    "silent": (lazy("Unknown"), lazy("the rig does not answer")),
}
"""For each state: whether stimulation is on, and one more thing to know."""


def state_of(context: Context) -> str:
    """The rig's state as far as it is known now."""
    rig = context.rig
    if not rig.connected or rig.status is None:
        return "unreachable"
    if rig.age_s is None or not (rig.age_s <= SILENT_S):
        return "silent"
    return rig.status.state


def plays_passive(context: Context) -> bool:
    """Whether what the rig plays is a passive test, in which it refuses every pulse."""
    status, current = context.rig.status, context.runner.current
    return current is not None and current.kind == PASSIVE and status is not None and status.test_id == current.test_id


def torque_now(context: Context) -> tuple[float | None, float | None]:
    """The newest torque (N·m) and its age (s); no torque where it is old or no number, no age where none ever came."""
    torque_nm, age_s = context.runner.hub.torque()
    status = context.rig.status
    known = status is not None and status.torque_nm is not None and age_s is not None and age_s <= TORQUE_OLD_S
    return (torque_nm if known else None), age_s


def now(context: Context, principal: Principal | None) -> dict[str, Any]:
    """What the rig does now. Without a sign-in: the state only, nothing about a participant."""
    state = state_of(context)
    if state in ("arming", "running") and plays_passive(context):
        state = PASSIVE
    flow, more = WORDS[state]
    torque_nm, age_s = torque_now(context)
    shown: dict[str, Any] = {
        "state": state,
        "flow": str(flow),
        "more": str(more),
        "at": clock(context.clock.utc()),
        "emulated": context.settings.emulated,
        "ready": state == "ready",
    }
    if principal is None:
        return shown
    current, status = context.runner.current, context.rig.status
    angle_rad = context.runner.hub.angle()
    return {
        **shown,
        "torque_nm": torque_nm,
        "torque_age_s": age_s,
        "test": {"id": current.test_id, "participant": current.participant} if current else None,
        "notice": notice_key(context, state),
        "sensor": status is not None and status.angle.present,
        "angle_deg": None if angle_rad is None else round(math.degrees(angle_rad), 1),
    }


def notice_key(context: Context, state: str) -> str:
    """A key that changes when the notice changes."""
    told = f"{status.latch} {status.reason}" if (status := context.rig.status) else ""
    return hashlib.sha256(f"{state} {told}".encode()).hexdigest()[:12]


def what_to_check(reason: str) -> str:
    """What a person should check before pressing *Reconnect*."""
    if reason.startswith(("load cell", "load_cell")):
        return "Check the cable and the power of the load cell. Then press Reconnect."
    if reason.startswith("stimulator"):
        return "Check the cable of the stimulator, and that it is switched on. Then press Reconnect."
    return "Check cables and power of the stimulator and the load cell. Then press Reconnect."
