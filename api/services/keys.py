"""Keys and tokens: of controllers, made by who may approve models for one participant and one day; and of programs."""

from __future__ import annotations

from typing import Any

from stimrig.api.clock import utc_label
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services import participants
from stimrig.api.services.context import Context
from stimrig.api.sessions import controllers
from stimrig.api.sessions.controllers import KeyFor
from stimrig.api.sessions.playing import refuse_archived
from stimrig.api.store import locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Token


def make(context: Context, who: Principal, code: str, body: KeyFor, tags: Tags | None = None) -> tuple[str, Token, int]:
    """Make a key: its text, its row, and the participant's new version.

    Raises ApiError: 403 who makes it lacks a scope; 409 archived; 412 changed since it was seen; 422 as `plan_within`.
    """
    row = participants.find(context, code)
    controllers.refuse_maker_without(who)
    refuse_archived(row)
    with context.store.read() as session:  # first: then the plan is wider for no other reason
        locking.check(session, participants.within(session, code), tags)
    plan = controllers.plan_within(body, row)
    return controllers.make_key(context.auth, body.name, code, plan, who.name, who.token_hash, tags)


def revoke(context: Context, code: str, key_id: str, by: str) -> None:
    """Revoke a key of a participant. Raises NotFoundError: it has none of this id today."""
    if not controllers.revoke_key(context.auth, code, key_id, by):
        raise NotFoundError("key", key_id, f"The page of {code} lists its keys.")


def make_reader(context: Context, name: str, days: int, by: str) -> dict[str, Any]:
    """Make a key that only reads models, of all participants."""
    expires_utc = utc_label(context.clock.unix_s() + 86400.0 * days)
    text = context.auth.issue(name, [Scope.READ_MODEL], by, expires_utc=expires_utc)
    return {"key": text, "prefix": text[:12], "scopes": [Scope.READ_MODEL], "expires_utc": expires_utc}


def scopes_of(names: list[str]) -> list[Scope]:
    """Return the scopes of these names. Raises ApiError (422): there is none of a name."""
    known = {scope.value for scope in Scope}
    if wrong := [name for name in names if name not in known]:
        detail = f"Unknown: {', '.join(wrong)}. There are: {', '.join(sorted(known))}."
        raise ApiError(422, "invalid-input", "No such scope", detail)
    return [Scope(name) for name in names]


def all_tokens(context: Context) -> list[dict[str, Any]]:
    """List all tokens by their prefix; never their text."""
    rows = context.store.all(Token, order=Token.created_utc)
    return [
        {key: value for key, value in row.as_dict().items() if key not in ("hash", "made_by")} | {"id": row.hash[:16]}
        for row in rows
    ]
