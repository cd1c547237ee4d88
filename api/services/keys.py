"""Keys and tokens: of controllers, made by who may approve models for one participant and one day; and of programs."""

from __future__ import annotations

from typing import Any

from stimrig.api.clock import utc_label
from stimrig.api.people.auth import Principal
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.sessions import controllers
from stimrig.api.sessions.controllers import KeyFor
from stimrig.api.sessions.playing import refuse_archived
from stimrig.api.sessions.requests import TokenIn
from stimrig.api.store import locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Token


def make(context: Context, principal: Principal, code: str, body: KeyFor, tags: Tags) -> tuple[str, Token, int]:
    """Make a key: its text, its row, and the participant's new version.

    Raises ApiError: 403 who makes it lacks a scope; 409 archived; 412 changed since it was seen; 422 as `plan_within`.
    """
    row = participants.find(context, code)
    controllers.refuse_maker_without(principal)
    refuse_archived(row)
    with context.store.read() as session:  # first: then the plan is wider for no other reason
        locking.check(session, participants.within(session, code), tags)
    plan = controllers.plan_within(body, row)
    return controllers.make_key(context.auth, body.name, code, plan, principal.name, principal.token_hash, tags)


def issue_token(context: Context, body: TokenIn, by: str) -> dict[str, Any]:
    """Issue a token to a program; its text is shown this once."""
    ends = utc_label(context.clock.unix_s() + 86400.0 * body.days) if body.days else None
    text = context.auth.issue(body.name, body.scopes, by, expires_utc=ends)
    return {"token": text, "name": body.name, "scopes": body.scopes, "expires_utc": ends}


def all_tokens(context: Context) -> list[dict[str, Any]]:
    """List all tokens by the first digits of their hash; never their text."""
    rows = context.store.all(Token, order=Token.created_utc)
    hidden = ("hash", "made_by")
    return [
        {"id": row.hash[:16], **{name: value for name, value in row.as_dict().items() if name not in hidden}}
        for row in rows
    ]
