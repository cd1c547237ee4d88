"""The administrator's page: people, keys and tokens, the audit trail."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import PlainTextResponse, Response

from stimrig.api import local_time
from stimrig.api.people.auth import ROLES
from stimrig.api.services import keys
from stimrig.api.store import audit
from stimrig.api.store.tables import AuditEntry
from stimrig.api.web.dependencies import Administrator, Ctx
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False, prefix="/administration")
NEWEST = 60
"""Entries of the audit trail that are shown; the export has all of them."""
MAY: dict[str, str] = {
    "clinician": "runs tests, approves models",
    "operator": "runs tests; approves nothing",
    "reader": "looks on; may stop, like everyone",
    "administrator": "everything",
}


@router.get("")
async def show(request: Request, context: Ctx, _principal: Administrator) -> Response:
    """Show people, tokens and the newest entries of the audit trail."""

    def gather() -> dict[str, Any]:
        entries = context.store.all(AuditEntry, order=AuditEntry.seq)
        return {
            "users": [{**user, "role": role_of(user["scopes"])} for user in context.people.documents()],
            "tokens": [token for token in keys.all_tokens(context) if token["origin"] == "issued"],
            "entries": entries[: -NEWEST - 1 : -1],
            "count": len(entries),
            "first_broken": audit.first_broken(entries),
        }

    return page(
        request,
        "administration.html",
        **await asyncio.to_thread(gather),
        roles=[(name, words, ROLES[name]) for name, words in MAY.items()],
        now_utc=context.clock.utc(),
    )


def role_of(scopes: list[str]) -> str:
    """Return the role that holds exactly these scopes; else their names."""
    return next((role for role, its_scopes in ROLES.items() if set(its_scopes) == set(scopes)), ", ".join(scopes))


@router.get("/audit.jsonl")
async def export(context: Ctx, _principal: Administrator) -> Response:
    """Export the audit trail, one JSON object a line, as `stimrig audit verify --file` takes it in."""
    entries = await asyncio.to_thread(lambda: context.store.all(AuditEntry, order=AuditEntry.seq))
    lines = "".join(json.dumps(entry.as_dict(), ensure_ascii=False) + "\n" for entry in entries)
    headers = {"Content-Disposition": 'attachment; filename="stimrig-audit.jsonl"'}
    return PlainTextResponse(lines, media_type="application/x-ndjson", headers=headers)


def detail_words(detail: dict[str, Any]) -> str:
    """Write an entry's details on one line; hashes are shortened, the export has them whole."""
    parts = []
    for name, value in detail.items():
        if value in (None, "", [], {}):
            continue
        if isinstance(value, dict):
            value = detail_words(value)
        elif isinstance(value, list):
            value = ", ".join(str(item) for item in value)
        elif name == "until":
            value = local_time.until(value)
        text = str(value)
        short = f"{text[:12]}…" if len(text) == 64 and " " not in text else text
        parts.append(f"{name.replace('_', ' ')} {short}")
    return " · ".join(parts)


environment.filters["detail_words"] = detail_words
