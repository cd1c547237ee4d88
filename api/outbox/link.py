"""The line to the centre: five requests, each answered with little JSON, or with one line about what is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from http.cookiejar import CookieJar
from typing import Any
from urllib.parse import urlsplit

import httpx

from stimrig.api.clock import Clock
from stimrig.api.outbox.chain import Position
from stimrig.api.outbox.messages import (
    BucketError,
    HeadsOut,
    KeyRefusedError,
    LackingFilesOut,
    LackingOut,
    PieceOut,
    PlaceOut,
    RefusedError,
    UnreachableError,
    WrongAnswerError,
    document,
    read,
)
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.settings import loopback

LONGEST_ANSWER = 1_000_000
LONGEST_S = 120.0
"""For an answer that has begun."""
LONGEST_TEXT = 200
TIMEOUT = httpx.Timeout(30.0, connect=10.0)


class NoCookies(CookieJar):
    """Keeps none: a centre that sets more and more of them fills no memory, and gets none back."""

    def extract_cookies(self, response: Any, request: Any) -> None:
        """As `CookieJar`."""


class Link:
    """Asks a centre.

    `url`, `key`: where it answers, and the rig's key there; `transport`: another way to it, for tests.
    """

    def __init__(self, url: str, key: str, clock: Clock, transport: httpx.BaseTransport | None = None) -> None:
        self.url, self.clock, self._key = url, clock, key
        headers = {"Authorization": f"Bearer {key}", "Accept-Encoding": "identity", "Accept": "application/json"}
        # A proxy of the environment is for the way out only: on loopback a key would pass it in the clear.
        trusted = not loopback(urlsplit(url).hostname or "")
        self.http = httpx.Client(
            base_url=url, headers=headers, timeout=TIMEOUT, transport=transport, follow_redirects=False,
            trust_env=trusted, cookies=NoCookies(),
        )  # fmt: skip

    def hello(self, said: dict[str, Any]) -> Position:
        """Say who is there; where the centre stands in the chain."""
        return read(PlaceOut, self._ask("POST", "/v1/rig/hello", json=said)).position()

    def items(self, chain: str, items: list[dict[str, Any]]) -> Position:
        """Send items; where the centre stands after them."""
        return read(PlaceOut, self._ask("POST", "/v1/rig/items", json={"chain": chain, "items": items})).position()

    def heads(self, chain: str, item: int) -> list[Receipt]:
        """What the centre countersigned of the audit trail, after the receipt of an item."""
        found = read(HeadsOut, self._ask("GET", "/v1/rig/heads", params={"chain": chain, "item": item})).heads
        if not all(one.key and one.holds for one in found):
            raise WrongAnswerError("the answer's `heads` are not as the centre signed them")
        return found

    def wanted(self, limit: int) -> list[LackingOut]:
        return read(LackingFilesOut, self._ask("GET", "/v1/rig/files", params={"limit": limit}), limit).files

    def send(self, sha256: str, offset: int, pieces: Iterator[bytes], length: int) -> PieceOut:
        """Send a file's bytes from a place on."""
        headers = {"Content-Length": str(length), "Content-Type": "application/octet-stream"}
        where = f"/v1/rig/files/{sha256}"
        return read(PieceOut, self._ask("PUT", where, params={"offset": offset}, content=pieces, headers=headers))

    def close(self) -> None:
        self.http.close()

    def _ask(self, method: str, path: str, **given: Any) -> dict[str, Any]:
        try:
            with self.http.stream(method, path, **given) as response:
                body = self._read(response)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            words = self._words(error) or type(error).__name__
            raise UnreachableError(f"{self.url}: {words}") from error
        status = response.status_code
        if status == 401:
            raise KeyRefusedError(f"{self.url}: key revoked, or unknown there; set STIMRIG_CENTRE_KEY to a new one")
        try:
            if 200 <= status < 300:
                return document(body)
            if 400 <= status < 600:
                raise self._refusal(status, body)
        except WrongAnswerError as error:
            raise WrongAnswerError(f"{self.url}{path}: {error}; is it a centre of this version?") from None
        raise WrongAnswerError(f"{self.url}{path}: answered {status}; give the centre's own address, no redirect")

    def _read(self, response: httpx.Response) -> bytes:
        """The answer's body, as long as answers are."""
        began_s, body = self.clock.monotonic_s(), bytearray()
        if response.headers.get("Content-Encoding", "identity") != "identity":
            raise WrongAnswerError(f"{self.url}: the answer is compressed; nobody asked for that")
        for piece in response.iter_bytes():
            body += piece
            if len(body) > LONGEST_ANSWER:
                raise WrongAnswerError(f"{self.url}: the answer is longer than 1 MB; is it a centre?")
            if self.clock.monotonic_s() - began_s > LONGEST_S:
                raise UnreachableError(f"{self.url}: the answer did not end within {LONGEST_S:g} s")
        return bytes(body)

    def _refusal(self, status: int, body: bytes) -> RefusedError | BucketError:
        try:
            said = document(body)
        except WrongAnswerError:  # a proxy in between says it in its own way
            said = {}
        code = one_line(said.get("type")).rpartition("/")[2]
        words = self._words(f"{said.get('title') or 'refused'}: {said.get('detail') or status}")
        if status == 507:
            return BucketError(f"{self.url}: the centre's bucket is full or gone ({words})")
        return RefusedError(f"{self.url}: {words} ({status})", code, said)

    def _words(self, said: object) -> str:
        """What came, for people; without the key, which something in between may have sent back."""
        return one_line(str(said or "").replace(self._key, "…"))


def one_line(value: object) -> str:
    """Words of the centre for people: on one line, and not many."""
    words = " ".join("".join(sign if sign.isprintable() else " " for sign in str(value or "")).split())
    return words if len(words) <= LONGEST_TEXT else words[: LONGEST_TEXT - 1] + "…"
