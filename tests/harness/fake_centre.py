"""A centre as decision 0013 describes it, in memory; and a line to it that drops, cuts and repeats, or answers rubbish.

Written from the decision alone: what it keeps it checks by itself.
"""

from __future__ import annotations

import copy
import hashlib
import json
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs

import httpx

KEY = "key-of-the-rig"
ZEROS = "0" * 64
FIELDS = ("seq", "kind", "key", "sha256", "file", "file_bytes", "at_utc", "previous")


def canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def answer(code: int, **body: Any) -> httpx.Response:
    return httpx.Response(code, json=body)


def problem(status: int, code: str, **extra: Any) -> httpx.Response:
    return answer(status, type=f"/problems/{code}", title=code, status=status, detail="as the fake says", **extra)


@dataclass
class FakeCentre:
    """What it has: chains of items, files whole and in part, and what rigs said."""

    chains: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    parts: dict[str, bytes] = field(default_factory=dict)
    hellos: list[dict[str, Any]] = field(default_factory=list)
    keys: set[str] = field(default_factory=lambda: {KEY})
    bucket_full: bool = False
    taken: int = 0
    """Bytes of files that were taken in."""

    def handle(self, request: httpx.Request) -> httpx.Response:
        body = request.read()
        if request.headers.get("Authorization", "").removeprefix("Bearer ") not in self.keys:
            return problem(401, "unauthorized")
        path, query = request.url.path, parse_qs(request.url.query.decode())
        if (request.method, path) == ("POST", "/v1/rig/hello"):
            return self.hello(json.loads(body))
        if (request.method, path) == ("POST", "/v1/rig/items"):
            return self.items(body)
        if (request.method, path) == ("GET", "/v1/rig/files"):
            return answer(200, files=self.wanted(int(query["limit"][0])))
        if request.method == "PUT" and path.startswith("/v1/rig/files/"):
            return self.put(path.rpartition("/")[2], int(query["offset"][0]), body)
        return problem(404, "not-found")

    def hello(self, said: dict[str, Any]) -> httpx.Response:
        self.hellos.append(said)
        return answer(200, **self.place(said["chain"]), utc="2026-11-23T00:00:00.000Z")

    def place(self, chain: str) -> dict[str, Any]:
        held = self.chains.get(chain) or [{"seq": 0, "hash": ZEROS}]
        return {"seq": held[-1]["seq"], "hash": held[-1]["hash"]}

    def items(self, body: bytes) -> httpx.Response:
        assert len(body) <= 4_000_000
        said = json.loads(body)
        assert len(said["items"]) <= 500
        held = list(self.chains.get(said["chain"], []))
        for item in said["items"]:
            if item["seq"] <= len(held):
                if held[item["seq"] - 1]["hash"] != item["hash"]:
                    return problem(409, "forked")
                continue
            if item["seq"] != len(held) + 1:
                return problem(409, "out-of-order", seq=len(held))
            own = sha256(canonical({name: item[name] for name in FIELDS}))
            before = held[-1]["hash"] if held else ZEROS
            if (own, before, sha256(canonical(item["body"]))) != (item["hash"], item["previous"], item["sha256"]):
                return problem(422, "hash-differs")
            held.append(item)
        self.chains[said["chain"]] = held
        return answer(200, **self.place(said["chain"]))

    def wanted(self, limit: int) -> list[dict[str, Any]]:
        named = {i["file"]: i["file_bytes"] for held in self.chains.values() for i in held if i["file"] is not None}
        lacking = [(digest, size) for digest, size in named.items() if digest not in self.files][:limit]
        return [{"sha256": d, "bytes": size, "have_bytes": len(self.parts.get(d, b""))} for d, size in lacking]

    def put(self, digest: str, offset: int, body: bytes) -> httpx.Response:
        assert len(body) <= 8_000_000
        if self.bucket_full:
            return problem(507, "bucket-failed")
        if digest in self.files:
            return answer(200, have_bytes=len(self.files[digest]), whole=True)
        held = self.parts.get(digest, b"")
        if offset != len(held):
            return problem(409, "other-offset", have_bytes=len(held))
        named = {i["file"]: i["file_bytes"] for chain in self.chains.values() for i in chain}
        held += body
        self.taken += len(body)
        if len(held) < named[digest]:
            self.parts[digest] = held
            return answer(200, have_bytes=len(held), whole=False)
        self.parts.pop(digest, None)
        if sha256(held) != digest:
            return problem(422, "hash-differs")
        self.files[digest] = held
        return answer(200, have_bytes=len(held), whole=True)

    # ---- to look at ----------------------------------------------------------------------------------------------

    def newest(self, kind: str) -> dict[str, dict[str, Any]]:
        """What it knows of each row of a kind, over all chains."""
        items = (item for held in self.chains.values() for item in held if item["kind"] == kind)
        return {item["key"]: item["body"] for item in items}

    def backup(self) -> FakeCentre:
        return copy.deepcopy(self)

    def restore(self, saved: FakeCentre) -> None:
        """Be what it was when the backup was made."""
        kept = saved.backup()
        self.chains, self.files, self.parts = kept.chains, kept.files, kept.parts


RUBBISH: list[Callable[[], httpx.Response]] = [
    lambda: httpx.Response(200, content=b"<html>not a centre</html>"),
    lambda: httpx.Response(200, content=b"[" * 200_000),
    lambda: httpx.Response(200, content=b"\xff\xfe\x00"),
    lambda: httpx.Response(200, content=b" " * 1_000_001),
    lambda: httpx.Response(302, headers={"Location": "http://127.0.0.1:1/elsewhere"}),
    lambda: httpx.Response(204),
    lambda: httpx.Response(500, content=b"broken"),
    lambda: httpx.Response(502, content=b"<html>proxy</html>"),
    lambda: answer(200, seq=True, hash=ZEROS, files={}, have_bytes="7", whole=1),
    lambda: answer(200, seq=-1, hash=ZEROS, files=[{"sha256": "../x"}], have_bytes=-1, whole=False),
    lambda: answer(200, seq=1.5, hash=7, files=[7], have_bytes=2**70, whole=True),
    lambda: answer(200, seq=0, hash="f" * 64, files=[{"sha256": "a" * 64, "bytes": 1}], have_bytes=9, whole=None),
    lambda: answer(200, seq=10**400, hash="f" * 64, files=None, have_bytes=None, whole=True),
    lambda: httpx.Response(200, headers={"Content-Encoding": "gzip"}, content=b""),
    lambda: problem(409, "out-of-order", seq=10**6),
    lambda: problem(409, "other-offset", have_bytes=10**12),
    lambda: problem(422, "hash-differs"),
]


@dataclass
class BadLine:
    """A way to a centre that does harm by chance; as long as `harm` is 0 it does none.

    Attributes
    ----------
    harm : float
        Share of the requests to which something happens.
    """

    centre: FakeCentre
    chance: random.Random
    harm: float = 0.0
    rubbish: bool = False
    requests: int = 0
    saved: list[FakeCentre] = field(default_factory=list)

    def __call__(self, request: httpx.Request) -> httpx.Response:
        self.requests += 1
        if self.chance.random() >= self.harm:
            return self.centre.handle(request)
        harms = [self._lost, self._unanswered, self._cut, self._twice, self._busy, self._cut_answer, self._older]
        return self.chance.choice([*harms, self._forgets, *[self._rubbish] * self.rubbish])(request)

    def _lost(self, _request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("the line is down")

    def _unanswered(self, request: httpx.Request) -> httpx.Response:
        self.centre.handle(request)
        raise httpx.ReadTimeout("no answer came")

    def _cut(self, request: httpx.Request) -> httpx.Response:
        body = request.read()
        if request.method == "PUT":  # what arrived of it is kept
            short = httpx.Request("PUT", request.url, headers={"Authorization": request.headers["Authorization"]},
                                  content=body[: self.chance.randrange(len(body) + 1)])  # fmt: skip
            self.centre.handle(short)
        raise httpx.WriteError("cut")

    def _twice(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.centre.handle(request)
        return self.centre.handle(request)

    def _busy(self, _request: httpx.Request) -> httpx.Response:
        return problem(503, "busy")

    def _cut_answer(self, request: httpx.Request) -> httpx.Response:
        whole = self.centre.handle(request)
        return httpx.Response(whole.status_code, content=whole.content[: self.chance.randrange(len(whole.content))])

    def _forgets(self, request: httpx.Request) -> httpx.Response:
        """It forgets what it had of files in part."""
        self.centre.parts.clear()
        return self._lost(request)

    def _older(self, request: httpx.Request) -> httpx.Response:
        """It is restored from a backup; the next one is made."""
        if self.saved:
            self.centre.restore(self.saved.pop())
        else:
            self.saved.append(self.centre.backup())
        return self._lost(request)

    def _rubbish(self, _request: httpx.Request) -> httpx.Response:
        return self.chance.choice(RUBBISH)()
