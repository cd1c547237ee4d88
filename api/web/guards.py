"""Dependencies that authorise a request: scopes, the CSRF token of a session, `If-Match`, and the right to stop.

A controller's key opens the routes in `OPEN` for its participant only. `Auth.identify` refuses a bound key unless it is
called from here, so a new route is closed to keys. `api.sessions.trials` limits the trials that a key may play.
"""

from __future__ import annotations

import asyncio
import hmac
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import urlsplit

from fastapi import Depends, Header, Request, Security
from fastapi.responses import Response
from fastapi.security import APIKeyCookie, APIKeyHeader, HTTPBearer
from pydantic import ValidationError
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import defer
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, HTTPConnection

from stimrig.api.errors import ApiError, forbidden, not_answering
from stimrig.api.models.places import site_of, stored_site
from stimrig.api.models.registry import Versions
from stimrig.api.people.auth import Principal, Scope, outside
from stimrig.api.sessions.controllers import unapproved
from stimrig.api.sessions.requests import StopIn
from stimrig.api.store import Store, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Model, Participant, Recording, Test
from stimrig.api.web.middleware import SAFE_METHODS, STOP, wants_html

POLLED = ("/rig/", "/v1/jobs/")
"""Paths that scripts of pages poll."""
BEARER = HTTPBearer(scheme_name="token", description="a token, or a controller's key", auto_error=False)
SESSION = APIKeyCookie(
    name="stimrig_session", scheme_name="session", auto_error=False,
    description="set by `POST /v1/sessions`; everything but GET sends its `csrf` as `X-CSRF-Token`, too",
)  # fmt: skip
Token = Annotated[object, Security(BEARER)]
Session = Annotated[object, Security(SESSION)]
"""For the OpenAPI document, which is given the name of its service's cookie; `Auth.identify` reads both."""


def require(scope: Scope | None = None) -> Callable[..., Awaitable[Principal]]:
    """A dependency: who holds the scope, or anyone with a valid token or session; a session sends its CSRF token."""

    async def check(request: Request, _token: Token, _session: Session) -> Principal:
        context = request.app.state.context
        principal = await identified(request)
        if scope is not None and not principal.may(scope):
            scopes = ", ".join(sorted(principal.scopes))
            raise forbidden(f"This needs the scope {scope}; {principal.name} holds {scopes}.")
        if request.method in SAFE_METHODS:
            return principal
        sent = request.headers.get("x-csrf-token", "").encode()
        if principal.csrf is not None and not hmac.compare_digest(sent, principal.csrf.encode()):
            raise ApiError(403, "csrf", "The page is out of date", "Load the page again and repeat what you did.")
        if scope is Scope.APPROVE_MODEL:
            await asyncio.to_thread(context.people.refuse_unconfirmed, principal)
        return principal

    return check


async def identified(request: Request) -> Principal:
    """Authenticate a request; a person's own action restarts the idle time of the session."""
    context = request.app.state.context
    principal = await context.auth.authenticate(request, bound=True)
    if principal.participant is not None:
        await asyncio.to_thread(refuse_outside, context.versions, principal, request.method, request.url.path)
    request.state.principal = principal
    if principal.page_session is not None and is_action(request):
        await asyncio.to_thread(context.auth.record_action, principal.page_session)
    if wants_html(request) or not request.url.path.startswith("/v1/"):
        # before anything of the page is read: what it shows is not older
        request.state.version = await asyncio.to_thread(_page_version, context.store, request)
    return principal


def _page_version(store: Store, request: Request) -> int:
    """Return the version of what a page shows, by the names in its address; 0 where it has none."""
    names = request.path_params
    with store.read() as session:
        if request.url.path == "/rig/angle":
            return locking.pose_version(session)
        model = session.get(Model, names.get("model_id", ""), options=[defer(Model.document)])
        row = session.get(Participant, model.participant if model else names.get("code", ""))
        return row.version if row else 0


def is_action(request: Request) -> bool:
    """Return whether a request is a person's action; what scripts poll is not."""
    if request.method not in SAFE_METHODS:
        return True
    by_script = request.headers.get("sec-fetch-dest") == "empty"
    return not by_script and not request.url.path.startswith(POLLED)


OPEN = (
    f"POST {STOP}",
    "POST /v1/tests",
    "GET /v1/sequences",
    "GET /v1/participants/(?P<code>[^/]+)/(?:model|tracking)",
    "POST /v1/models/(?P<model>[^/]+)/prediction",
    "POST /v1/models/(?P<model>[^/]+)/widths",
    "GET /v1/tests/(?P<test>[^/]+)",
    "WS /v1/tests/(?P<test>[^/]+)/live",
    "GET /v1/recordings/(?P<recording>[^/]+)(?:/csv)?",
)
"""Routes that a controller's key opens for its participant: of the models the approved one and those tracked from it
under the valid approval, of the recordings those of tests."""


def refuse_outside(registry: Versions, principal: Principal, method: str, path: str) -> None:
    """Let pass who is bound to nobody, and a key on what it opens.

    Raises ApiError: 403 the key is of another site; or, the same for what is another participant's, for what is not
    there, and for routes that no key opens. 409 a model is asked, and none of the key's participant is approved.
    """
    if principal.participant is None:
        return
    if not _opens(registry, principal.participant, f"{method} {path}"):
        raise outside(principal.participant)
    row: Participant = registry.store.get(Participant, principal.participant)
    if stored_site((principal.plan or {}).get("site")) != site_of(row):
        detail = "The participant is stimulated at another site now. A person makes a key for it."
        raise ApiError(403, "other-site", "This key is of another site", detail)


def _opens(registry: Versions, participant: str, request: str) -> bool:
    match = next(filter(None, (re.fullmatch(pattern, request) for pattern in OPEN)), None)
    if match is None or not match.lastgroup:
        return match is not None
    key = match[match.lastgroup]
    if match.lastgroup == "code":
        return key == participant
    if match.lastgroup == "model":
        return _approved(registry, participant, key)
    row = registry.store.get(Test if match.lastgroup == "test" else Recording, key)
    return row is not None and row.participant == participant and (isinstance(row, Test) or row.test_id is not None)


def _approved(registry: Versions, participant: str, model_id: str) -> bool:
    """Return whether a version is approved today, or tracked from the approved one. Raises ApiError (409)."""
    approval = registry.approved(participant)
    if approval is None:
        raise unapproved(participant)
    base = re.escape(approval.model_id)
    return re.fullmatch(rf"{base}(\.{approval.id}\.[0-9]+)?", model_id) is not None


def same_origin(request: HTTPConnection) -> None:
    """Refuse what another site's page sends where no CSRF token can be asked for: a sign-in, a WebSocket."""
    origin = request.headers.get("origin")
    if origin and urlsplit(origin).netloc != request.headers.get("host"):
        raise forbidden("The request came from a page of another site.")


def set_cookie(context: Any, answer: Response, cookie: str) -> None:
    """The session's cookie: not for scripts, not for other sites."""
    age_s, secure = int(context.auth.session_s), context.settings.secure_cookies
    name = context.auth.cookie_name
    answer.set_cookie(name, cookie, max_age=age_s, httponly=True, samesite="strict", secure=secure)


def local(target: str) -> str:
    """Return the address if it is on this host, else that of the first page."""
    plain = target.startswith("/") and not target.startswith("//") and target.isprintable() and "\\" not in target
    return target if plain else "/"


MOST_TAGS = 20
"""Tags of `If-Match` that are read; further ones are ignored."""


def if_match(document: str, needed: bool = True) -> Any:
    """Return a dependency: the versions on which a request was decided; 428 where it does not say.

    `document`: the one whose `ETag` is sent; `needed`: false for a decision that only takes away.
    """
    header = Header(None, description=f"the `ETag` of `GET {document}` on which this is decided")

    async def tags(request: Request, if_match: list[str] | None = header) -> Tags | None:
        if if_match is None and not needed:
            return None
        sent = tuple(re.findall(r'"([\w.-]{1,120})"', ",".join(if_match or ()), re.ASCII)[:MOST_TAGS])
        if not sent:
            participant = request.state.principal.participant  # a controller's key reads no participant
            names = {"code": "{code}", **request.path_params}
            address = f"/v1/participants/{participant}/model" if participant else document.format(**names)
            detail = f"Send the ETag of GET {address} as If-Match, as you last saw it. Nothing was done."
            raise ApiError(428, "version-missing", "Say what this was decided on", detail)
        return sent

    return Depends(tags)


PATIENCE_S, LONGEST_PATIENCE_S = 0.5, 3.0
"""A stop waits so long for its body; and so long where nothing but a right in it would allow the stop."""
DEFAULT_REASON = "stop pressed"
RIGHT = APIKeyHeader(name="X-Stop-Right", scheme_name="right", auto_error=False, description="a page's right to stop")
Right = Annotated[object, Security(RIGHT)]


@dataclass(frozen=True)
class Press:
    """An authorised stop. With `by_key` the answer names no other participant."""

    by: str
    reason: str
    by_key: bool = False


async def anyone_who_may_stop(request: Request, _token: Token, _session: Session, _right: Right) -> Press:
    """A dependency for stop: who holds a page's right, or is signed in, be it that the session or token ran out.

    The right is looked at first: it needs no database, and nothing that holds back guesses holds it back.
    """
    coming, refused = asyncio.create_task(_stop_sent(request)), None
    try:
        for patience_s in (PATIENCE_S, LONGEST_PATIENCE_S - PATIENCE_S):
            await asyncio.wait([coming], timeout=patience_s)
            reason, in_form = coming.result() if coming.done() else (DEFAULT_REASON, "")
            if (by := _holder(request, request.headers.get("x-stop-right") or in_form)) is not None:
                return Press(by, reason)
            if refused is None:
                try:
                    return await _signed_in(request, reason)
                except ApiError as error:
                    refused = error
    finally:
        coming.cancel()
    assert refused is not None
    refused.title = "Nothing was stopped"
    refused.detail = f"Use the emergency switch on the stimulator now, or sign in and press Stop. {refused.detail}"
    raise refused


def _holder(request: Request, right: str) -> str | None:
    """Return who was given a page's right to stop; None: it is none, or of a test that is over."""
    context = request.app.state.context
    current, status = context.runner.current, context.rig.status
    by = context.stop_rights.holder(right, {current and current.test_id, status and status.test_id})
    if by is not None:
        request.state.stop_right = right
    return by


async def _signed_in(request: Request, reason: str) -> Press:
    """Return the press of a signed-in user; without the database, of the last user known for the credential.

    Raises ApiError: nobody is signed in, or nobody is known.
    """
    auth = request.app.state.context.auth
    try:
        principal = await auth.authenticate_within(request, PATIENCE_S, forgive_age=True, bound=True)
        return Press(principal.name, reason, principal.participant is not None)
    except (TimeoutError, SQLAlchemyError):
        if (name := auth.last_known_name(request)) is not None:
            return Press(name, reason, by_key=True)  # whether a key asks is not known: then nobody else is named
        raise not_answering() from None


async def _stop_sent(request: Request) -> tuple[str, str]:
    """The body's reason and right; whatever it holds, a stop is a stop."""
    try:
        if "form" in request.headers.get("content-type", ""):
            form = await request.form()
            return str(form.get("reason") or DEFAULT_REASON)[:200], str(form.get("right") or "")
        body = await request.body()
        return StopIn.model_validate_json(body).reason if body.strip() else DEFAULT_REASON, ""
    except (ValidationError, ValueError, ApiError, HTTPException, ClientDisconnect):
        return DEFAULT_REASON, ""
