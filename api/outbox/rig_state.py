"""The rig's state as the service tells anybody on this machine: `GET /health`, which asks for no token."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import urlsplit

import httpx

from stimrig.api.settings import Settings, loopback

PATIENCE_S = 2.0
LONGEST_ANSWER = 65536


def of(settings: Settings) -> dict[str, Any]:
    """`state` and `reason`; null where nobody tells them. Where the service answers stands in its lock."""
    unknown = {"state": None, "reason": None}
    try:
        address = json.loads((settings.data_dir / "service.lock").read_text("utf-8"))["address"]
        if not loopback(urlsplit(address).hostname or ""):
            return unknown
        with (
            httpx.Client(timeout=PATIENCE_S, trust_env=False) as http,
            http.stream("GET", f"{address}/health") as answer,
        ):
            body = next(answer.iter_bytes(LONGEST_ANSWER), b"")
        rig = json.loads(body)["rig"]
        return {"state": _text(rig.get("state")), "reason": _text(rig.get("reason"))}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, httpx.HTTPError, httpx.InvalidURL):
        return unknown


def _text(value: object) -> str | None:
    return value[:200] if isinstance(value, str) else None
