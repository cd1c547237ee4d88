"""A provider of our own (OpenID Connect), that keeps to the rules unless it is told how not to."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from joserfc import jws
from joserfc.jwk import ECKey, OKPKey, RSAKey

CLIENT, SECRET = "the rig", "s3cret/with:signs"
RSA, EC, ED = RSAKey.generate_key(2048), ECKey.generate_key("P-256"), OKPKey.generate_key("Ed25519")
STRANGER = RSAKey.generate_key(2048)


def encoded(value: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(value).encode()).rstrip(b"=").decode()


class Double:
    """What it says can be changed: `claims` are put over the right ones, `answers` over whole answers by path."""

    def __init__(self) -> None:
        self.key: Any = RSA
        self.kid, self.alg, self.sub = "k1", "RS256", "subject-1"
        self.claims: dict[str, Any] = {}
        self.about: dict[str, Any] = {}
        self.groups: list[str] = []
        self.answers: dict[str, Callable[[Any], None]] = {}
        self.codes: dict[str, dict[str, str]] = {}
        self.asked: list[str] = []
        self.issuer = ""

    def code_for(self, address: str) -> dict[str, str]:
        """What the browser brings back after somebody has signed in at the page of this address."""
        asked = {name: texts[0] for name, texts in parse_qs(urlsplit(address).query).items()}
        code = secrets.token_urlsafe(8)
        self.codes[code] = asked
        return {"code": code, "state": asked["state"]}

    def token(self, asked: dict[str, str]) -> str:
        now = int(time.time())
        claims = {
            "iss": self.issuer, "aud": CLIENT, "sub": self.sub, "iat": now, "exp": now + 300, "nonce": asked["nonce"],
            "auth_time": now, "name": "Ada Çelik", "groups": self.groups, **self.claims,
        }  # fmt: skip
        claims = {name: value for name, value in claims.items() if value is not None}
        return self.signed(claims)

    def signed(self, claims: dict[str, Any]) -> str:
        if self.alg == "none":
            return f"{encoded({'alg': 'none'})}.{encoded(claims)}."
        head = {"alg": self.alg, "kid": self.kid}
        if self.alg == "HS256":  # a library that takes the public key for a shared secret believes it
            text = f"{encoded(head)}.{encoded(claims)}"
            mark = hmac.new(RSA.as_pem(private=False), text.encode(), hashlib.sha256).digest()
            return f"{text}.{base64.urlsafe_b64encode(mark).rstrip(b'=').decode()}"
        return jws.serialize_compact(head, json.dumps(claims).encode(), self.key, algorithms=[self.alg])

    def documents(self, path: str) -> dict[str, Any] | None:
        if path == "/.well-known/openid-configuration":
            return {
                "issuer": self.issuer, "authorization_endpoint": f"{self.issuer}/authorize",
                "token_endpoint": f"{self.issuer}/token", "jwks_uri": f"{self.issuer}/jwks", **self.about,
            }  # fmt: skip
        if path == "/jwks":
            return {"keys": [{**self.key.as_dict(private=False), "kid": self.kid, "use": "sig"}]}
        return None

    def redeem(self, form: dict[str, str], head: str) -> tuple[int, dict[str, Any]]:
        """As RFC 6749 and RFC 7636 have it; a code is good once."""
        asked = self.codes.pop(form.get("code", ""), None)
        pair = base64.b64decode(head.partition(" ")[2]).decode().split(":")
        challenge = hashlib.sha256(form.get("code_verifier", "").encode()).digest()
        challenged = base64.urlsafe_b64encode(challenge).rstrip(b"=").decode()
        if asked is None or asked["code_challenge"] != challenged or asked["redirect_uri"] != form["redirect_uri"]:
            return 400, {"error": "invalid_grant"}
        if [unquote(part) for part in pair] != [CLIENT, SECRET]:
            return 401, {"error": "invalid_client"}
        return 200, {"access_token": "a", "token_type": "Bearer", "id_token": self.token(asked)}


def handler(double: Double) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.give(lambda: (200, double.documents(self.path)))

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            form = {name: texts[0] for name, texts in parse_qs(body).items()}
            self.give(lambda: double.redeem(form, self.headers.get("Authorization", "")))

        def give(self, make: Callable[[], tuple[int, Any]]) -> None:
            double.asked.append(self.path)
            if self.path in double.answers:
                double.answers[self.path](self)
                return
            self.say(*make())

        def say(self, status: int, body: Any, **head: str) -> None:
            text = body if isinstance(body, bytes) else json.dumps(body).encode()
            self.send_response(status)
            for name, value in head.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        def log_message(self, *_: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            pass

    return Handler


@contextmanager
def running() -> Iterator[Double]:
    double = Double()
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler(double))
    double.issuer = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield double
    finally:
        server.shutdown()
        server.server_close()
