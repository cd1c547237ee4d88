"""What a route asks of whoever comes: a scope, and of a session's form its CSRF token."""

from __future__ import annotations

import asyncio
import hmac
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import Request, Security
from fastapi.security import APIKeyCookie, HTTPBearer

from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.store import seen
from stimrig.api.web import decisions
from stimrig.api.web.headers import wants_html
from stimrig.api.web.key_guard import refuse_outside

SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
POLLED = ("/rig/", "/jobs/now/", "/v1/jobs/")
"""What pages ask for again and again by themselves."""
BEARER = HTTPBearer(scheme_name="token", description="a token, or a controller's key", auto_error=False)
SESSION = APIKeyCookie(
    name="stimrig_session", scheme_name="session", auto_error=False,
    description="set by `POST /v1/sessions`; everything but GET sends its `csrf` as `X-CSRF-Token`, too",
)  # fmt: skip
Token = Annotated[object, Security(BEARER)]
Session = Annotated[object, Security(SESSION)]
"""For the OpenAPI document, which is given the name of its service's cookie; `Auth.identify` reads both."""


def require(scope: Scope) -> Callable[..., Awaitable[Principal]]:
    """A dependency: the principal, if the scope is held and a session's form carries its CSRF token."""

    async def check(request: Request, _token: Token, _session: Session) -> Principal:
        principal = await identified(request)
        if not principal.may(scope):
            who = principal.name
            detail = f"This needs the scope {scope}; {who} holds {', '.join(sorted(principal.scopes))}."
            raise ApiError(403, "forbidden", "Not allowed", detail)
        await check_csrf(request, principal)
        await decisions.take(request)
        if scope is Scope.APPROVE_MODEL and request.method not in SAFE_METHODS:
            await request.app.state.context.people.confirmed(request, principal)
        return principal

    check.__name__ = f"require_{scope.name.lower()}"
    return check


async def identified(request: Request) -> Principal:
    """Who asks; where it is a person's own doing, the session is not idle."""
    context = request.app.state.context
    auth, principal = context.auth, await context.auth.ask(request, bound=True)
    if principal.participant is not None:
        await asyncio.to_thread(refuse_outside, context.versions, principal, request.method, request.url.path)
    request.state.who = principal
    if principal.page_session is not None and by_a_person(request):
        auth.idle.acted(principal.page_session.hash)
    if wants_html(request) or not request.url.path.startswith("/v1/"):
        # before anything of the page is read: what it shows is not older
        seen.looked.set(await asyncio.to_thread(context.store.seen, context.clock))
    return principal


def by_a_person(request: Request) -> bool:
    """Whether a person did something, as far as a request tells: what scripts read by themselves is nobody's action."""
    if request.method not in SAFE_METHODS:
        return True
    by_script = request.headers.get("sec-fetch-dest") == "empty"
    return not by_script and not request.url.path.startswith(POLLED)


async def anyone_signed_in(request: Request, _token: Token, _session: Session) -> Principal:
    """A dependency: anyone with a valid token or session."""
    principal = await identified(request)
    await check_csrf(request, principal)
    return principal


async def anyone_even_locked(request: Request, _token: Token, _session: Session) -> Principal:
    """A dependency: anyone with a valid token or session, which may be locked: to unlock it, or to sign out."""
    principal = request.state.who = await request.app.state.context.auth.ask(request, forgive_lock=True)
    await check_csrf(request, principal)
    return principal


async def check_csrf(request: Request, principal: Principal) -> None:
    """Refuse a session's write whose form or header does not carry the session's CSRF token."""
    if principal.csrf is None or request.method in SAFE_METHODS:
        return
    sent: Any = request.headers.get("x-csrf-token")
    if sent is None and "form" in request.headers.get("content-type", ""):
        sent = (await request.form()).get("csrf")
    if not isinstance(sent, str) or not hmac.compare_digest(sent.encode(), principal.csrf.encode()):
        raise ApiError(403, "csrf", "The form is out of date", "Load the page again and repeat what you did.")
