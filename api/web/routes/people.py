"""Users, their sessions, and keys for controllers."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import Field, StringConstraints, ValidationError

from stimrig.api.errors import NotFoundError
from stimrig.api.people.auth import ROLES, Scope, unauthorized
from stimrig.api.services import keys
from stimrig.api.sessions import controllers
from stimrig.api.sessions.controllers import KeyFor
from stimrig.api.sessions.requests import Body, PersonName, TokenIn
from stimrig.api.store import audit
from stimrig.api.store.tables import AuditEntry
from stimrig.api.web.dependencies import (
    PROBLEM,
    Administrator,
    Anyone,
    Approver,
    Ctx,
    ParticipantVersion,
    Tester,
    UserVersion,
)
from stimrig.api.web.guards import local, same_origin, set_cookie
from stimrig.api.web.openapi import TOO_MANY
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.people import AuditOut, KeyOut, ListedToken, ListedUser, SessionOut, TokenOut, UserOut

router = APIRouter(prefix="/v1", tags=["people"], responses=PROBLEM)
token_router = APIRouter(prefix="/v1", tags=["administration"], responses=PROBLEM)
Password = Annotated[str, StringConstraints(min_length=10, max_length=200)]
NAME = "letters of any language, digits, spaces and . _ @ - ' , ( ), at most 80"


class UserIn(Body):
    """A person who may sign in on the page."""

    name: Annotated[PersonName, Field(description=NAME, examples=["Ada Çelik"])]
    password: Password
    scopes: Annotated[list[Annotated[Scope, Field(strict=False)]], Field(min_length=1)] = ROLES["clinician"]


class SignIn(Body):
    """Name and password, or a token."""

    name: Annotated[str, StringConstraints(max_length=320)] = ""
    password: Annotated[str, StringConstraints(max_length=200)] = ""
    token: Annotated[str, StringConstraints(max_length=400)] = ""


class PasswordIn(Body):
    """A new password."""

    password: Password


class ConfirmIn(Body):
    """The password, once more."""

    password: Annotated[str, StringConstraints(min_length=1, max_length=200)]


@router.post("/users", status_code=201, **describe_answer(UserOut, 201, "added"))
def add_user(context: Ctx, principal: Administrator, body: UserIn) -> dict[str, Any]:
    """Add a person; the default scopes are a clinician's."""
    row = context.people.add(body.name, body.password, body.scopes, principal.name)
    return {"name": row.name, "scopes": body.scopes, "created_utc": row.created_utc}


@router.get("/users", **describe_answer(list[ListedUser]))
def list_users(context: Ctx, _principal: Administrator) -> list[dict[str, Any]]:
    """All users; a new password sends the person's `version` as `If-Match`."""
    return context.people.documents()


@router.put("/users/{name}/password", status_code=204)
def set_password(context: Ctx, principal: Administrator, name: str, tags: UserVersion, body: PasswordIn) -> Response:
    """A new password; the person's sessions end. One that changes its own goes on under the cookie of the answer."""
    answer = Response(status_code=204)
    if (cookie := context.people.change_password(name, body.password, principal, tags)) is not None:
        set_cookie(context, answer, cookie)
    return answer


@router.delete("/users/{name}", status_code=204)
def remove_user(context: Ctx, principal: Administrator, name: str) -> None:
    """Nobody signs in under this name any more."""
    context.people.remove(name, principal.name)


@router.post(
    "/sessions",
    status_code=201,
    response_model=None,
    responses={429: TOO_MANY, 201: {"model": SessionOut, "description": "signed in; the session is in `Set-Cookie`"}},
    openapi_extra={"requestBody": {"content": {"application/json": {"schema": SignIn.model_json_schema()}}}},
)
async def sign_in(
    context: Ctx, request: Request, next: Annotated[str, Query(description="of a form: where to go on")] = "/"
) -> Response:
    """Sign in with name and password, or a token (JSON or a form); the session is a cookie. 429 after wrong tries."""
    same_origin(request)
    form = "form" in request.headers.get("content-type", "")
    try:
        if form:
            sent = SignIn.model_validate(dict(await request.form()))
        else:
            sent = SignIn.model_validate_json(await request.body())
    except (ValidationError, TypeError):
        raise unauthorized("Send `name` and `password`, or `token`.") from None
    address = request.client.host if request.client else ""
    if sent.token.strip():
        cookie = await run_in_threadpool(context.auth.sign_in, sent.token.strip(), address)
    else:
        cookie = await run_in_threadpool(context.people.sign_in, sent.name.strip(), sent.password, address)
    if form:
        answer: Response = RedirectResponse(local(next), 303)
    else:
        principal = await run_in_threadpool(context.auth.cookie, cookie)
        scopes = sorted(principal.scopes)
        answer = JSONResponse({"name": principal.name, "scopes": scopes, "csrf": principal.csrf}, 201)
    set_cookie(context, answer, cookie)
    return answer


@router.post("/sessions/confirm", status_code=204)
def confirm(context: Ctx, principal: Anyone, body: ConfirmIn) -> None:
    """The password once more, before a model is approved."""
    context.people.confirm(principal, body.password)


@router.post("/sessions/acted", status_code=204)
async def acted(_principal: Anyone) -> None:
    """Note that a person has typed or moved the pointer on a page: its session is not idle."""


@router.delete("/sessions/current", status_code=204)
def sign_out(context: Ctx, principal: Anyone) -> None:
    """Sign out."""
    if principal.page_session is None:
        raise NotFoundError("session", "current", "A token has none; DELETE /v1/tokens/{id} revokes it.")
    context.auth.sign_out(principal.page_session.hash)


@router.post("/participants/{code}/keys", status_code=201, **describe_answer(KeyOut, 201, "made"))
def participant_key(
    context: Ctx, principal: Approver, code: str, tags: ParticipantVersion, body: KeyFor, response: Response
) -> dict[str, Any]:
    """A key with which a controller plays trials of one participant until the end of the day, within a plan.

    Who makes it holds `run-test`, `read-live` and `read-model`, too, and answers for what it plays. Its text is shown
    this once. `DELETE /v1/participants/{code}/keys/{id}` revokes it.
    """
    text, row, version = controllers.make_key(context.auth, principal, code, body, tags)
    response.headers["ETag"] = f'"{version}"'
    fields = ("name", "prefix", "scopes", "expires_utc", "participant", "plan")
    return {"key": text, "id": row.hash[:16], **{name: getattr(row, name) for name in fields}}


@router.delete("/participants/{code}/keys/{key_id}", status_code=204)
def revoke_participant_key(context: Ctx, principal: Tester, code: str, key_id: str) -> None:
    """Revoke a key of a participant; its trial ends at once."""
    if not controllers.revoke_key(context.auth, code, key_id, principal.name):
        raise NotFoundError("key", key_id, f"The page of {code} lists its keys.")


@token_router.post("/tokens", status_code=201, **describe_answer(TokenOut, 201, "issued"))
def issue_token(context: Ctx, principal: Administrator, body: TokenIn) -> dict[str, Any]:
    """Issue a token; its text is shown this once."""
    return keys.issue_token(context, body, principal.name)


@token_router.get("/tokens", **describe_answer(list[ListedToken]))
def list_tokens(context: Ctx, _principal: Administrator) -> list[dict[str, Any]]:
    """All tokens, by their prefix; never their text."""
    return keys.all_tokens(context)


@token_router.delete("/tokens/{token_id}", status_code=204)
def revoke_token(context: Ctx, principal: Administrator, token_id: str) -> None:
    """Revoke a token."""
    if not context.auth.revoke(token_id, principal.name):
        raise NotFoundError("token", token_id, "GET /v1/tokens lists them.")


@token_router.get("/audit", **describe_answer(AuditOut))
def trail(context: Ctx, _principal: Administrator) -> dict[str, Any]:
    """The audit trail, and whether its chain holds."""
    entries = context.store.all(AuditEntry, order=AuditEntry.seq)
    broken = audit.first_broken(entries)
    return {"whole": broken is None, "first_broken": broken, "entries": [entry.as_dict() for entry in entries]}
