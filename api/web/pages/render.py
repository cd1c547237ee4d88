"""Templates to responses; what every page shows; problems as pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from jinja2 import Environment
from markupsafe import Markup
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api import language
from stimrig.api.clock import zone_name
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import LOCKED, Principal, Scope
from stimrig.api.store import seen
from stimrig.api.web.dependencies import Context
from stimrig.api.web.pages import changes, choices, rig_state
from stimrig.api.web.pages.changes import Again
from stimrig.api.web.pages.environment import environment

environment.filters["what_to_check"] = rig_state.what_to_check
environment.globals["colours_media"] = choices.MEDIA

LOOK_S = 1.0


@dataclass(frozen=True)
class Face:
    """What the pages of an application look like: its templates, and what each of them has at its top.

    `bar` is asked with the request, who looks at the page, and the same where nothing keeps that from doing more.
    """

    environment: Environment
    bar: Callable[[Request, Principal | None, Principal | None], dict[str, Any]]


BACK = {"models": "Back to the model", "participants": "Back to the participant", "tests": "Back to the test"}


def page(request: Request, template: str, status: int = 200, **values: Any) -> HTMLResponse:
    """A page, with the bar that every page has."""
    face: Face = getattr(request.app.state, "face", RIG)
    looking: Principal | None = getattr(request.state, "who", None)
    principal = None if looking is None or looking.locked else looking
    bar = {**face.bar(request, looking, principal), "version": request.app.version}
    shown = {"bar": bar, "principal": principal, "here": here(request), "zone": zone(request.app.state.context)}
    shown["signed"] = signed(principal)
    shown["colours"] = choices.colours(request)
    html = face.environment.get_template(template).render(request=request, **shown, **values)
    return HTMLResponse(html, status_code=status)


def signed(principal: Principal | None) -> Markup:
    """What every form carries: that it is of this session, and what the page was shown on."""
    told = seen.shown.get() or seen.looked.get()  # a form that comes back for want of something is as old as it was
    fields = {"csrf": (principal.csrf if principal else None) or "", "seen": told or ""}
    field = Markup('<input type="hidden" name="{}" value="{}">')
    return Markup("").join(field.format(name, value) for name, value in fields.items())


def zone(context: Context) -> str:
    """The time zone of all times on the page: Europe/Berlin (UTC+1)."""
    name, offset = zone_name(), language.zone(context.clock.utc())
    return offset if name in ("", offset, "Etc/UTC") else f"{name} ({offset})"


async def look(request: Request) -> None:
    """Find out who looks at a page that anybody may see, for its bar.

    Nobody, where the database does not answer at once: what a stop did is said all the same, and the stop button is
    there for who was signed in when the database last answered.
    """
    if getattr(request.state, "who", None) is not None:
        return
    context = request.app.state.context
    try:
        request.state.who = await context.auth.ask_within(request, LOOK_S, forgive_age=True)
    except ApiError:
        return
    except (SQLAlchemyError, TimeoutError):
        name = context.auth.seen_on_page(request)
        if name is not None and getattr(request.state, "stop_right", None) is None:
            request.state.stop_right = _right_of(context, name)


def stop_right(request: Request, principal: Principal | None) -> str | None:
    """What the page's stop button is good for; the answer to a stop keeps the right that was used, and no longer."""
    if principal is None:
        return getattr(request.state, "stop_right", None)
    return _right_of(request.app.state.context, principal.name)


def _right_of(context: Context, name: str) -> str:
    current = context.runner.current
    return context.stop_rights.give(name, current.test_id if current else None)


def fragment(context: Context, template: str, principal: Principal, place: str) -> str:
    """A part of a page by itself, for a script that renews it; `place`: the page it is on."""
    bar = bar_of(context, principal)
    values = {"principal": principal, "here": place, "signed": signed(principal)}
    return environment.get_template(template).render(bar=bar, **values)


def bar_of(context: Context, principal: Principal | None) -> dict[str, Any]:
    """What every page has at its top."""
    return {
        "rig": context.rig.status,
        "connected": context.rig.connected,
        "current": context.runner.current,
        "now": rig_state.now(context, principal),
        "may_rearm": principal is not None and principal.may(Scope.REARM),
    }


def rig_bar(request: Request, looking: Principal | None, principal: Principal | None) -> dict[str, Any]:
    """What every page of a rig's service has at its top, with what its stop button is good for."""
    return {**bar_of(request.app.state.context, principal), "right": stop_right(request, looking)}


RIG = Face(environment, rig_bar)
"""The pages of a rig's service."""


def here(request: Request) -> str:
    """The address of the page that is shown; of the one with the form where a form was refused."""
    if request.method == "GET":
        return request.url.path + (f"?{request.url.query}" if request.url.query else "")
    back = back_from(request.url.path)
    return back[0] if back else "/"


def problem_page(request: Request, problem: ApiError, again: Again | None = None) -> Response:
    """A problem as a page that says what to do; the way to the door where nobody is signed in."""
    if problem.code == LOCKED[0]:
        return RedirectResponse(f"/locked?next={quote(here(request), safe='')}", 303)
    if problem.status == 401 and request.method == "GET":
        return RedirectResponse(f"/sign-in?next={quote(request.url.path)}", 303)
    values: dict[str, Any] = {"problem": problem, "back": back_from(request.url.path), "again_at": request.url.path}
    if isinstance(problem, seen.ChangedError):
        values |= {"rows": changes.rows(problem.extra["changes"]), "again": again}
    response = page(request, "problem.html", problem.status, **values)
    response.headers.update(problem.headers)
    return response


def back_from(path: str) -> tuple[str, str] | None:
    """Address and words of the page that a form was on."""
    parts = path.strip("/").split("/")
    if len(parts) < 3 or parts[0] not in BACK:
        return None
    return f"/{parts[0]}/{quote(parts[1])}", BACK[parts[0]]
