"""Templates to responses; what every page shows; problems and the stop's evidence as pages."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from api.errors import ApiError
from rig.messages import StopEvidence

HERE = Path(__file__).parent
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # with no-referrer a form's Origin is "null", and the door asks for it
    "Cache-Control": "no-store",
}

BACK = {"models": "Back to the model", "participants": "Back to the participant", "tests": "Back to the test"}

environment = Environment(
    loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    if value is None:
        return "–"
    text = f"{value:.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def when(label: str | None) -> str:
    """A UTC label in the machine's local time, to the minute."""
    if not label:
        return "–"
    return datetime.fromisoformat(label.replace("Z", "+00:00")).astimezone().strftime("%d %b %Y, %H:%M")


def figures(value: float | None) -> str:
    """A number to three significant figures, without powers of ten where they can be done without."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}" if digits <= 6 else f"{value:.2g}"
    return text.replace("-", "−")


environment.filters["number"] = number
environment.filters["figures"] = figures
environment.filters["when"] = when


def page(request: Request, template: str, status: int = 200, **values: Any) -> HTMLResponse:
    """A page, with the bar that every page has."""
    context = request.app.state.context
    bar = {
        "rig": context.rig.status,
        "connected": context.rig.connected,
        "current": context.trials.current,
        "version": request.app.version,
    }
    try:
        principal = context.auth.identify(request, forgive_age=True)
    except ApiError:
        principal = None
    html = environment.get_template(template).render(request=request, bar=bar, principal=principal, **values)
    return HTMLResponse(html, status_code=status, headers=SECURITY_HEADERS)


def wants_html(request: Request) -> bool:
    """Whether a browser's navigation or form asked, not a program."""
    return "text/html" in request.headers.get("accept", "")


def problem_page(request: Request, problem: ApiError) -> Response:
    """A problem as a page that says what to do; the way to the door where nobody is signed in."""
    if problem.status == 401 and request.method == "GET":
        return RedirectResponse(f"/sign-in?next={quote(request.url.path)}", 303)
    response = page(request, "problem.html", problem.status, problem=problem, back=back_from(request.url.path))
    response.headers.update(problem.headers)
    return response


def back_from(path: str) -> tuple[str, str] | None:
    """Address and words of the page that a form was on."""
    parts = path.strip("/").split("/")
    if len(parts) < 3 or parts[0] not in BACK:
        return None
    return f"/{parts[0]}/{quote(parts[1])}", BACK[parts[0]]


def stop_page(request: Request, evidence: StopEvidence) -> Response:
    """The rig's evidence that stimulation has stopped."""
    return page(request, "stop.html", evidence=evidence)
