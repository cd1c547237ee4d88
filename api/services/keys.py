"""Tokens of programs; `stimrig.api.sessions.controllers` makes the keys of controllers."""

from __future__ import annotations

from typing import Any

from stimrig.api.clock import utc_label
from stimrig.api.services.context import Context
from stimrig.api.sessions.requests import TokenIn
from stimrig.api.store.tables import Token


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
