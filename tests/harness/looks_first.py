"""A client of tests that decides on what is there now."""

from __future__ import annotations

import re
from typing import Any

import httpx

from stimrig.api.client.connection import SendsVersions


class LooksFirst(SendsVersions):
    """Decides on what is there now: a test that decides on something older says so by an `If-Match` of its own."""

    requires_request_body = True

    def __init__(self, token: str = "") -> None:
        super().__init__({})
        self._token = {"authorization": f"Bearer {token}"} if token else {}

    def auth_flow(self, request: httpx.Request) -> Any:
        own = {name: request.headers[name] for name in ("authorization", "cookie") if name in request.headers}
        self._headers = own | self._token
        self.seen.clear()
        return super().auth_flow(request)

    def _documents(self, request: httpx.Request) -> list[str]:
        """None where a form says what its page has shown."""
        said = re.search(rb'\b(seen|latch|calibration)(=|"\r\n\r\n)[^&\r]', request.read())
        return [] if said and "form" in request.headers.get("content-type", "") else super()._documents(request)
