"""Tokens and the audit trail, for administrators."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.outbox import receipts
from stimrig.api.people.auth import Scope
from stimrig.api.sessions.requests import TokenIn
from stimrig.api.store.tables import AuditEntry, Token
from stimrig.api.web.dependencies import PROBLEM, Administrator, Ctx
from stimrig.api.web.responses.base import answers
from stimrig.api.web.responses.people import AuditOut, ListedToken, TokenOut

router = APIRouter(prefix="/v1", tags=["administration"], responses=PROBLEM)


@router.post("/tokens", status_code=201, **answers(TokenOut, 201, "issued"))
def issue_token(context: Ctx, who: Administrator, body: TokenIn) -> dict[str, Any]:
    """Issue a token; its text is shown this once."""
    known = {scope.value for scope in Scope}
    wrong = [scope for scope in body.scopes if scope not in known]
    if wrong:
        detail = f"Unknown: {', '.join(wrong)}. There are: {', '.join(sorted(known))}."
        raise ApiError(422, "invalid-input", "No such scope", detail)
    scopes = [Scope(scope) for scope in body.scopes]
    text = context.auth.issue(body.name, scopes, who.name, expires_utc=body.expires_utc)
    return {"token": text, "name": body.name, "scopes": body.scopes, "expires_utc": body.expires_utc}


@router.get("/tokens", **answers(list[ListedToken]))
def list_tokens(context: Ctx, _who: Administrator) -> list[dict[str, Any]]:
    """All tokens, by their prefix; never their text."""
    rows = context.store.all(Token, order=Token.created_utc)
    return [
        {key: value for key, value in row.as_dict().items() if key not in ("hash", "made_by")} | {"id": row.hash[:16]}
        for row in rows
    ]


@router.delete("/tokens/{token_id}", status_code=204)
def revoke_token(context: Ctx, who: Administrator, token_id: str) -> None:
    """Revoke a token."""
    if not context.auth.revoke(token_id, who.name):
        raise NotFoundError("token", token_id, "GET /v1/tokens lists them.")


@router.get("/audit", **answers(AuditOut))
def trail(context: Ctx, _who: Administrator) -> dict[str, Any]:
    """The audit trail, and whether its chain holds."""
    entries = context.store.all(AuditEntry, order=AuditEntry.seq)
    stands = receipts.of_folder(entries, context.settings.data_dir)
    return {
        "whole": stands.first_broken is None and stands.missing_since is None, "first_broken": stands.first_broken,
        "missing_since": stands.missing_since, "entries": [entry.as_dict() for entry in entries],
    }  # fmt: skip
