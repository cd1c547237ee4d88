"""Templates to responses; what every page shows; problems as pages."""

from __future__ import annotations

import hashlib
import math
from typing import Any
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api import local_time
from stimrig.api.clock import zone_name
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.sessions.joint_plan import PASSIVE
from stimrig.api.web.dependencies import Context
from stimrig.api.web.pages.environment import environment

IDENTIFY_TIMEOUT_S = 1.0
"""Time within which the database has to say who looks at a public page."""
NEWEST = 30
"""Rows of a long table that are shown before somebody asks for all."""
SILENT_S = 1.6
"""The rig answers once a second and sends its torque more often. After such a silence its state is unknown."""
TORQUE_OLD_S = 1.0
"""An older torque is not shown as the torque of now."""
WORDS: dict[str, tuple[str, str]] = {
    "ready": ("No stimulation", "ready"),
    "calibrating": ("No stimulation", "a calibration is open"),
    "arming": ("Stimulating", "begins"),
    "running": ("Stimulating", ""),
    PASSIVE: ("No stimulation", "passive movement"),
    "stopping": ("Stopping", "not confirmed yet"),
    "sealing": ("No stimulation", "saving the recording"),
    "latched": ("Stopped", "needs re-arm"),
    "uncertain": ("Restarted", "needs re-arm"),
    "disconnected": ("Disconnected", "see below what to check"),
    "unreachable": ("Unknown", "the rig cannot be reached"),
    "silent": ("Unknown", "the rig does not answer"),
}
"""For each state: whether stimulation is on, and one more thing to know."""
BACK = {"models": "Back to the model", "participants": "Back to the participant", "tests": "Back to the test"}


def rows_shown(request: Request) -> int | None:
    """Return the requested number of rows of a long table; None: all."""
    return None if request.query_params.get("all") else NEWEST


# ---- pages ---------------------------------------------------------------------------------------------------------


def page(request: Request, template: str, status: int = 200, **values: Any) -> HTMLResponse:
    """Render a page, with the bar that every page has."""
    viewer: Principal | None = getattr(request.state, "principal", None)
    principal = None if viewer is None or viewer.ended else viewer
    context: Context = request.app.state.context
    right = getattr(request.state, "stop_right", None) if viewer is None else stop_right(context, viewer.name)
    bar = {
        "rig": context.rig.status,
        "current": context.runner.current,
        "now": rig_now(context, principal),
        "may_rearm": principal is not None and principal.may(Scope.REARM),
        "right": right,
        "version": request.app.version,
    }
    html = environment.get_template(template).render(
        request=request, bar=bar, principal=principal, here=here(request), zone=zone(context),
        shown_version=getattr(request.state, "version", 0), csrf=(viewer.csrf if viewer else None) or "", **values,
    )  # fmt: skip
    return HTMLResponse(html, status_code=status)


def zone(context: Context) -> str:
    """Name the time zone of all times on the page: Europe/Berlin (UTC+1)."""
    name, offset = zone_name(), local_time.zone(context.clock.utc())
    return offset if name in ("", offset, "Etc/UTC") else f"{name} ({offset})"


def here(request: Request) -> str:
    """Return the address of the page that is shown; the first page where a form was posted."""
    if request.method != "GET":
        return "/"
    return request.url.path + (f"?{request.url.query}" if request.url.query else "")


def stop_right(context: Context, name: str) -> str:
    """Return the right of the stop button on a page that this person sees."""
    current = context.runner.current
    return context.stop_rights.give(name, current.test_id if current else None)


async def identify_viewer(request: Request) -> None:
    """Identify the viewer of a public page, for its bar.

    Without an answer of the database the page has no viewer, and its stop button has the right of the last user known
    for the session. The page that answers a stop keeps the right that was used.
    """
    if getattr(request.state, "principal", None) is not None:
        return
    context: Context = request.app.state.context
    try:
        request.state.principal = await context.auth.authenticate_within(request, IDENTIFY_TIMEOUT_S, forgive_age=True)
    except ApiError:
        return
    except (SQLAlchemyError, TimeoutError):
        name = context.auth.last_known_name(request, on_page=True)
        if name is not None and getattr(request.state, "stop_right", None) is None:
            request.state.stop_right = stop_right(context, name)


def problem_page(request: Request, problem: ApiError) -> Response:
    """Show a problem and what to do; lead to the door where nobody is signed in."""
    if problem.status == 401 and request.method == "GET":
        return RedirectResponse(f"/sign-in?next={quote(here(request))}", 303)
    kind, *rest = request.url.path.strip("/").split("/")
    back = (f"/{kind}/{quote(rest[0])}", BACK[kind]) if len(rest) > 1 and kind in BACK else None
    response = page(request, "problem.html", problem.status, problem=problem, back=back)
    response.headers.update(problem.headers)
    return response


# ---- the rig's state -----------------------------------------------------------------------------------------------


def state_of(context: Context) -> str:
    """Return the rig's state as far as it is known now."""
    rig = context.rig
    if not rig.connected or rig.status is None:
        return "unreachable"
    if rig.age_s is None or not (rig.age_s <= SILENT_S):
        return "silent"
    return rig.status.state


def rig_now(context: Context, principal: Principal | None) -> dict[str, Any]:
    """Return the rig's state. Without a sign-in: the state only, nothing about a participant."""
    state, status, current, hub = state_of(context), context.rig.status, context.runner.current, context.runner.hub
    if state in ("arming", "running") and current is not None and current.kind == PASSIVE:
        # in a passive test the rig refuses every pulse
        state = PASSIVE if status is not None and status.test_id == current.test_id else state
    public = {
        "state": state,
        "flow": WORDS[state][0],
        "more": WORDS[state][1],
        "at": local_time.clock(context.clock.utc()),
        "emulated": context.settings.emulated,
        "ready": state == "ready",
    }
    if principal is None:
        return public
    (torque_nm, age_s), angle_rad = hub.torque(), hub.angle()
    known = status is not None and status.torque_nm is not None and age_s is not None and age_s <= TORQUE_OLD_S
    return {
        **public,
        "torque_nm": torque_nm if known else None,
        "torque_age_s": age_s,
        "test": {"id": current.test_id, "participant": current.participant} if current else None,
        "notice": notice_key(context, state),
        "angle_deg": None if angle_rad is None else round(math.degrees(angle_rad), 1),
    }


def notice_key(context: Context, state: str) -> str:
    """Return a key that changes when the notice changes; it is empty in states without a notice (notice.html)."""
    if state not in ("unreachable", "silent", "latched", "uncertain", "disconnected"):
        return ""
    latched = f"{status.latch} {status.reason}" if (status := context.rig.status) else ""
    return hashlib.sha256(f"{state} {latched}".encode()).hexdigest()[:12]


def what_to_check(reason: str) -> str:
    """Return what to check before pressing *Reconnect*."""
    devices = "cables and power of the stimulator and the load cell"
    if reason.startswith(("load cell", "load_cell")):
        devices = "the cable and the power of the load cell"
    elif reason.startswith("stimulator"):
        devices = "the cable of the stimulator, and that it is switched on"
    return f"Check {devices}. Then press Reconnect."


environment.filters["what_to_check"] = what_to_check
