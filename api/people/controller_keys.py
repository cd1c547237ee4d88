"""Keys of controllers: bound to one participant and one day, and to a plan of trials."""

from __future__ import annotations

import secrets
from typing import Any

from sqlalchemy import select

from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Auth, Principal, Scope
from stimrig.api.store.hashes import digest
from stimrig.api.store.tables import Token

SCOPES = [Scope.READ_MODEL, Scope.READ_LIVE, Scope.RUN_TEST]
"""Of these only what `stimrig.api.web.guards` opens."""


def refuse_without(maker: Principal) -> None:
    """403 to whoever lacks a scope that a key holds: it may do nothing that its maker may not."""
    lacking = [str(scope) for scope in SCOPES if not maker.may(scope)]
    if lacking:
        who = maker.name
        detail = f"A key holds {', '.join(SCOPES)}. Who makes one holds them all; {who} lacks {', '.join(lacking)}."
        raise ApiError(403, "forbidden", "Not allowed", detail)


def make(
    auth: Auth, name: str, participant: str, plan: dict[str, Any], by: str, made_by: str | None = None
) -> tuple[str, Token]:
    """A key that ends with its day: its text, shown this once, and its row.

    Parameters
    ----------
    name : str
        What people call the controller; the row's name is made unique, since tests are counted by it.
    participant : str
        The only one that it opens.
    plan : dict
        `current_ma`, `max_pulse_width_us`, `max_duration_s`, `trials`.
    by : str
        Who makes it.
    made_by : str, optional
        Hash of that one's token: once it is revoked or has expired, the key opens nothing.
    """
    text = f"stimrig_{secrets.token_urlsafe(32)}"
    own = f"{name} ({digest(text)[:6]})"
    until = auth.clock.end_of_day_utc()
    auth.issue(own, SCOPES, by, text=text, expires_utc=until, participant=participant, plan=plan, made_by=made_by)
    return text, auth.store.get(Token, digest(text))


def of(auth: Auth, participant: str) -> list[dict[str, Any]]:
    """Today's keys of a participant, newest first; `id` is for `revoke`, `state` says whether it opens anything."""
    with auth.store.read() as session:
        today = Token.created_utc >= auth.clock.start_of_day_utc()
        of_participant = select(Token).where(Token.participant == participant, today)
        rows = list(session.scalars(of_participant.order_by(Token.created_utc.desc())))
    return [{"id": row.hash[:16], "state": _state(auth, row), **row.as_dict()} for row in rows]


def _state(auth: Auth, row: Token) -> str:
    if row.revoked or auth.fallen(row):
        return "revoked"
    return "expired" if row.expires_utc is not None and row.expires_utc <= auth.clock.utc() else "valid"


def revoke(auth: Auth, participant: str, token_id: str, by: str) -> bool:
    """Revoke a key of a participant; False where there is none of that id."""
    return token_id in {row["id"] for row in of(auth, participant)} and auth.revoke(token_id, by)
