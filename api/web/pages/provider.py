"""Signing in through a provider: the way there, and what a browser brings back."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import Any
from urllib.parse import quote

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.people.pace import place_of
from stimrig.api.people.provider import FLOW_S, Flow, NotAcceptedError, Provider, SignedIn
from stimrig.api.web.dependencies import Context, Ctx
from stimrig.api.web.guards import local, set_cookie
from stimrig.api.web.pages.home import sign_in_page
from stimrig.api.web.pages.render import look, page

router = APIRouter(include_in_schema=False)
log = logging.getLogger("stimrig.provider")
NOT_ACCEPTED = (
    "The provider's answer was not accepted, and nobody was signed in. Begin again here, in this browser. If it stays "
    "so, an administrator sees the reason in the audit trail."
)


def the_provider(context: Context) -> Provider:
    """Raises NotFoundError: none is configured."""
    if context.provider is None:
        raise NotFoundError("provider", "sign-in", "Sign in with name and password, or with a token.")
    return context.provider


def flow_cookie(context: Context) -> str:
    """Its name; `__Host-` where TLS is in front: no other host of the domain can put one in its place."""
    own = context.auth.cookie_name.replace("session", "sign_in")
    return f"__Host-{own}" if context.settings.secure_cookies else own


@router.get("/sign-in/provider")
async def begin(request: Request, context: Ctx, next: str = "/", again: str = "") -> Response:
    """To the provider; `again`: the person of this session signs in once more, to confirm or to unlock."""
    provider = the_provider(context)
    held = ""
    if again:
        with contextlib.suppress(ApiError):
            who = await context.auth.ask(request, forgive_lock=True)
            held = who.session_hash or ""
    try:
        address, cookie = await provider.begin(local(next)[:500], held)
    except ApiError as error:
        return await sign_in_page(request, context, next, error)
    answer = RedirectResponse(address, 303)
    # Lax: the provider's page leads back here, and a cookie that is strict would stay behind
    answer.set_cookie(
        flow_cookie(context), cookie, max_age=int(FLOW_S), httponly=True, samesite="lax",
        secure=context.settings.secure_cookies,
    )  # fmt: skip
    return answer


@router.get("/sign-in/callback")
async def callback(request: Request, context: Ctx) -> Response:
    """What the provider's page has led back here with. Whatever it was, the flow's cookie is used up."""
    provider, address = the_provider(context), request.client.host if request.client else ""
    given = {name: text for name, text in request.query_params.items() if len(text) <= 4000}
    held = request.cookies.get(flow_cookie(context), "")
    try:
        if provider.began(held):  # else any page can have made a browser ask: nothing is counted or written down
            context.guesses.callback(place_of(address))
        flow = provider.flow_of(held, given)
        answer = await _finished(request, context, flow, await provider.finish(flow, given))
        context.guesses.callback_was_right(place_of(address))
    except NotAcceptedError as error:
        log.warning("a sign-in through %s was refused: %s", provider.issuer, error)
        if provider.began(held):
            await _note(context, address, str(error))
        answer = await sign_in_page(request, context, "/", ApiError(401, "not-accepted", "Not signed in", NOT_ACCEPTED))
    except ApiError as error:
        if error.status != 429:
            await _note(context, address, error.code)
        answer = await sign_in_page(request, context, "/", error)
    answer.delete_cookie(
        flow_cookie(context), httponly=True, samesite="lax", secure=context.settings.secure_cookies
    )  # fmt: skip
    return answer


async def _finished(request: Request, context: Context, flow: Flow, who: SignedIn) -> Response:
    """The session. Not a redirect: a browser that comes from elsewhere would not send the strict cookie along."""
    assert context.identities is not None
    name, token_hash = await asyncio.to_thread(context.identities.account, who)
    cookie = None
    if flow.session:
        await asyncio.to_thread(context.people.signed_in_again, flow.session, token_hash, name)
    else:
        cookie = await asyncio.to_thread(context.auth.open_session, token_hash, name, through=who.issuer)
    await look(request)
    answer = page(request, "signed_in.html", name=name, next=local(flow.next))
    answer.headers["Refresh"] = f"0; url={quote(local(flow.next), safe='/?&=%-._~+,')}"
    if cookie is not None:
        set_cookie(context, answer, cookie)
    return answer


async def _note(context: Context, address: str, why: str) -> None:
    """Into the trail; a database that does not answer keeps nobody from being told."""
    told: dict[str, Any] = {"address": address, "why": why[:200]}
    try:
        await asyncio.to_thread(context.store.note, context.clock, "provider", "sign in refused", "page", **told)
    except SQLAlchemyError:
        log.exception("a sign-in that was refused could not be written down")
