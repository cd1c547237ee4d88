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
from stimrig.api.local_time import clock
from stimrig.api.people.auth import LOCKED, Principal, Scope
from stimrig.api.sessions.joint_plan import PASSIVE
from stimrig.api.web.dependencies import Context
from stimrig.api.web.pages.environment import environment

COLOURS = "stimrig_colours"
"""The choice, written by `colours.js`; it says nothing about who chose."""
CHOICES = ("light", "dark", "system")
LOOK_S = 1.0


NEWEST = 30
"""Rows of a long table that are shown before somebody asks for all."""


def rows_shown(request: Request) -> int | None:
    """Return the requested number of rows of a long table; None: all."""
    return None if request.query_params.get("all") else NEWEST


BACK = {"models": "Back to the model", "participants": "Back to the participant", "tests": "Back to the test"}


def page(request: Request, template: str, status: int = 200, **values: Any) -> HTMLResponse:
    """A page, with the bar that every page has."""
    viewer: Principal | None = getattr(request.state, "principal", None)
    principal = None if viewer is None or viewer.locked else viewer
    context: Context = request.app.state.context
    bar = {**bar_of(context, principal), "right": stop_right(request, viewer), "version": request.app.version}
    common = {"bar": bar, "principal": principal, "here": here(request), "zone": zone(context)}
    common["shown_version"] = getattr(request.state, "version", 0)
    common["csrf"] = (viewer.csrf if viewer else None) or ""
    colours = request.cookies.get(COLOURS, "")
    common["colours"] = colours if colours in CHOICES else "system"
    html = environment.get_template(template).render(request=request, **common, **values)
    return HTMLResponse(html, status_code=status)


def zone(context: Context) -> str:
    """The time zone of all times on the page: Europe/Berlin (UTC+1)."""
    name, offset = zone_name(), local_time.zone(context.clock.utc())
    return offset if name in ("", offset, "Etc/UTC") else f"{name} ({offset})"


async def identify_viewer(request: Request) -> None:
    """Identify the viewer of a public page, for its bar.

    Without an answer of the database the page has no viewer, and its stop button has the right of the last user known
    for the session.
    """
    if getattr(request.state, "principal", None) is not None:
        return
    context = request.app.state.context
    try:
        request.state.principal = await context.auth.authenticate_within(request, LOOK_S, forgive_age=True)
    except ApiError:
        return
    except (SQLAlchemyError, TimeoutError):
        name = context.auth.last_known_name(request, on_page=True)
        if name is not None and getattr(request.state, "stop_right", None) is None:
            request.state.stop_right = _right_of(context, name)


def stop_right(request: Request, principal: Principal | None) -> str | None:
    """Return the right of the page's stop button; the answer to a stop keeps the right that was used."""
    if principal is None:
        return getattr(request.state, "stop_right", None)
    return _right_of(request.app.state.context, principal.name)


def _right_of(context: Context, name: str) -> str:
    current = context.runner.current
    return context.stop_rights.give(name, current.test_id if current else None)


def bar_of(context: Context, principal: Principal | None) -> dict[str, Any]:
    """Return the values of the bar at the top of every page."""
    return {
        "rig": context.rig.status,
        "connected": context.rig.connected,
        "current": context.runner.current,
        "now": rig_now(context, principal),
        "may_rearm": principal is not None and principal.may(Scope.REARM),
    }


def here(request: Request) -> str:
    """Return the address of the page that is shown; the first page where a form was posted."""
    if request.method != "GET":
        return "/"
    return request.url.path + (f"?{request.url.query}" if request.url.query else "")


def problem_page(request: Request, problem: ApiError) -> Response:
    """A problem as a page that says what to do; the way to the door where nobody is signed in."""
    if problem.code == LOCKED[0]:
        return RedirectResponse(f"/locked?next={quote(here(request), safe='')}", 303)
    if problem.status == 401 and request.method == "GET":
        return RedirectResponse(f"/sign-in?next={quote(request.url.path)}", 303)
    values: dict[str, Any] = {"problem": problem, "back": back_from(request.url.path)}
    response = page(request, "problem.html", problem.status, **values)
    response.headers.update(problem.headers)
    return response


def back_from(path: str) -> tuple[str, str] | None:
    """Address and words of the page that a form was on."""
    parts = path.strip("/").split("/")
    if len(parts) < 3 or parts[0] not in BACK:
        return None
    return f"/{parts[0]}/{quote(parts[1])}", BACK[parts[0]]


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


def rig_now(context: Context, principal: Principal | None) -> dict[str, Any]:
    """Return the rig's state. Without a sign-in: the state only, nothing about a participant."""
    state = state_of(context)
    if state in ("arming", "running") and plays_passive(context):
        state = PASSIVE
    flow, more = WORDS[state]
    torque_nm, age_s = torque_now(context)
    public: dict[str, Any] = {
        "state": state,
        "flow": str(flow),
        "more": str(more),
        "at": clock(context.clock.utc()),
        "emulated": context.settings.emulated,
        "ready": state == "ready",
    }
    if principal is None:
        return public
    current, status = context.runner.current, context.rig.status
    angle_rad = context.runner.hub.angle()
    return {
        **public,
        "torque_nm": torque_nm,
        "torque_age_s": age_s,
        "test": {"id": current.test_id, "participant": current.participant} if current else None,
        "notice": notice_key(context, state),
        "sensor": status is not None and status.angle.present,
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
    if reason.startswith(("load cell", "load_cell")):
        return "Check the cable and the power of the load cell. Then press Reconnect."
    if reason.startswith("stimulator"):
        return "Check the cable of the stimulator, and that it is switched on. Then press Reconnect."
    return "Check cables and power of the stimulator and the load cell. Then press Reconnect."


environment.filters["what_to_check"] = what_to_check
