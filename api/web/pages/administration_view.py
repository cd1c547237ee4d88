"""The administrator's page: people, keys and tokens, the audit trail."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import PlainTextResponse, RedirectResponse, Response

from stimrig.api import local_time
from stimrig.api.people.auth import ROLES
from stimrig.api.store import audit
from stimrig.api.store.tables import AuditEntry
from stimrig.api.web.dependencies import Administrator, Context, Ctx
from stimrig.api.web.pages import typed
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.typed import Text
from stimrig.api.web.routes import people

router = APIRouter(include_in_schema=False, prefix="/administration")
NEWEST = 60
MAY: dict[str, str] = {
    "clinician": "runs tests, approves models",
    "operator": "runs tests; approves nothing",
    "reader": "looks on; may stop, like everyone",
    "administrator": "everything",
}


@router.get("")
async def show(request: Request, context: Ctx, _who: Administrator) -> Response:
    """The page."""
    return await show_page(request, context)


async def show_page(request: Request, context: Context, key: dict[str, Any] | None = None) -> Response:
    """The page; with a key that was just made, the only time its text is seen."""

    def gather() -> dict[str, Any]:
        entries = context.store.all(AuditEntry, order=AuditEntry.seq)
        return {
            "users": [{**user, "role": role_of(user["scopes"])} for user in context.people.documents()],
            "tokens": [token for token in people.list_tokens(context, None) if token["origin"] == "issued"],  # pyright: ignore[reportArgumentType]
            "entries": entries[: -NEWEST - 1 : -1],
            "count": len(entries),
            "first_broken": audit.first_broken(entries),
        }

    found = await asyncio.to_thread(gather)
    structure = context.settings.structure
    return page(
        request, "administration.html", **found, key=key, roles=MAY, now_utc=context.clock.utc(), structure=structure
    )


def role_of(scopes: list[str]) -> str:
    """The role that holds exactly these scopes; else their names."""
    return next((name for name, held in ROLES.items() if set(held) == set(scopes)), ", ".join(scopes))


@router.post("/users")
async def add_user(
    context: Ctx, who: Administrator, name: Text = "", role: Text = "",
    password: Text = "",
) -> Response:  # fmt: skip
    """A new person."""
    body = typed.checked(people.UserIn, name=name.strip(), password=password, scopes=ROLES.get(role, []))
    await context.people.add(body.name, body.password, body.scopes, who.name)
    return back()


@router.post("/users/{name}/password")
async def set_password(context: Ctx, who: Administrator, name: str, password: Text = "") -> Response:
    """A new password."""
    body = typed.checked(people.PasswordIn, password=password)
    return await people.renew_password(context, who, name, body.password, back())


@router.post("/users/{name}/remove")
async def remove(context: Ctx, who: Administrator, name: str) -> Response:
    """Nobody signs in under this name any more."""
    await asyncio.to_thread(context.people.remove, name, who.name)
    return back()


@router.post("/keys")
async def make_key(
    request: Request, context: Ctx, who: Administrator, name: Text = "",
    days: Text = "30",
) -> Response:  # fmt: skip
    """A key for a controller; its text is shown on the answering page only."""
    body = typed.checked(people.KeyIn, name=name.strip(), days=typed.whole(days))
    made = await asyncio.to_thread(people.controller_key, context, who, body)
    return await show_page(request, context, {**made, "name": body.name})


@router.post("/tokens/{token_id}/revoke")
async def revoke(context: Ctx, who: Administrator, token_id: str) -> Response:
    """It opens nothing any more."""
    await asyncio.to_thread(people.revoke_token, context, who, token_id)
    return back()


@router.get("/audit.jsonl")
async def export(context: Ctx, _who: Administrator) -> Response:
    """The whole audit trail, one JSON object a line, as `stimrig audit verify --file` takes it in."""
    entries = await asyncio.to_thread(lambda: context.store.all(AuditEntry, order=AuditEntry.seq))
    lines = "".join(json.dumps(entry.as_dict(), ensure_ascii=False) + "\n" for entry in entries)
    headers = {"Content-Disposition": 'attachment; filename="stimrig-audit.jsonl"'}
    return PlainTextResponse(lines, media_type="application/x-ndjson", headers=headers)


def detail_words(detail: dict[str, Any]) -> str:
    """An entry's details on one line; hashes shortened, the export has them whole."""
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


def back() -> Response:
    """To the page."""
    return RedirectResponse("/administration", 303)
