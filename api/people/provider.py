"""A provider that signs people in (OpenID Connect 1.0, code flow with PKCE): what it is asked, and what is believed.

Its answers come over the network, so each is bounded in length and time, is read off any database connection, and
counts only once its signature and every claim hold. Nothing else in the service waits for it, a stop least of all.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import json
import logging
import math
import secrets
import ssl
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, urlencode

import httpx
from joserfc import jws
from joserfc.errors import JoseError
from joserfc.jwk import ECKey, OKPKey, RSAKey

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.settings import ServerSettings, safe_address
from stimrig.identify.json_text import BadJson, parse

log = logging.getLogger("stimrig.provider")
ALGORITHMS = {"RS256": RSAKey, "ES256": ECKey, "EdDSA": OKPKey, "Ed25519": OKPKey}
"""What an id_token may be signed with, and the kind of key that goes with it: never `none`, never a shared secret."""
ANSWER_S, ANSWER_BYTES = 8.0, 262_144
FLOW_S, LEEWAY_S, OLDEST_S = 600.0, 60.0, 900.0
"""A sign-in is to be finished within this time; clocks may differ by so much; and an id_token is no older."""
KNOWN_S, KEYS_AGAIN_S = 3600.0, 30.0
"""What a provider says of itself holds so long; for a key that is not known it is asked at most so often."""
MOST_AT_ONCE, MOST_USED = 16, 10_000
CALLBACK = "/sign-in/callback"


class NotAcceptedError(Exception):
    """What came back does not hold; its text is for the audit trail."""


@dataclass(frozen=True)
class Flow:
    """A sign-in that a browser has begun; the browser holds it, signed, and nothing is kept of it here."""

    id: str
    at_unix_s: float
    next: str  # address of the page that follows
    session: str = ""  # hash of the page session whose person is to sign in once more; empty: a new session


@dataclass(frozen=True)
class SignedIn:
    """Whom the provider has signed in."""

    issuer: str
    subject: str
    name: str  # as the provider writes it; nobody is found by it
    groups: tuple[str, ...]


class Provider:
    """One provider, and this service as its client.

    `settings`: the issuer and how to ask it; `key`: shared by all services of a database.
    """

    def __init__(self, settings: ServerSettings, clock: Clock, key: bytes) -> None:
        assert settings.oidc_issuer is not None and settings.oidc_public_url is not None
        self.settings, self.clock, self._key, self._secret = settings, clock, key, settings.oidc_secret()
        self.issuer, self.client_id = settings.oidc_issuer, settings.oidc_client_id or ""
        self.name = settings.oidc_name or self.issuer.partition("://")[2].partition("/")[0]
        self.redirect_uri = settings.oidc_public_url.rstrip("/") + CALLBACK
        self._about: tuple[float, dict[str, Any]] | None = None
        self._keys: tuple[float, list[dict[str, Any]]] | None = None
        self._tls: ssl.SSLContext | None = None
        self._used: OrderedDict[str, float] = OrderedDict()
        self._inside = 0

    # ---- to the provider, and back

    async def begin(self, next: str, session: str = "") -> tuple[str, str]:
        """Where the browser goes, and the cookie that it brings back. Raises ApiError: 503."""
        about = await self._told()
        flow = Flow(secrets.token_urlsafe(24), self.clock.unix_s(), next, session)
        challenge = hashlib.sha256(self._part(flow, "verifier").encode()).digest()
        asked = {
            "response_type": "code", "client_id": self.client_id, "redirect_uri": self.redirect_uri,
            "scope": self.settings.oidc_scope, "state": self._part(flow, "state"), "nonce": self._part(flow, "nonce"),
            "code_challenge": base64.urlsafe_b64encode(challenge).rstrip(b"=").decode(),
            "code_challenge_method": "S256",
            "prompt": "login", "max_age": "0",  # a rig's screen is shared: whoever was there before is not signed in
        }  # fmt: skip
        address = about["authorization_endpoint"]
        return f"{address}{'&' if '?' in address else '?'}{urlencode(asked)}", self._sealed(flow)

    def began(self, cookie: str) -> bool:
        """Whether the cookie is of a sign-in that was begun here."""
        text, _, mark = cookie.rpartition(".")
        return hmac.compare_digest(mark.encode(), self._mac("cookie", text).encode())

    def flow_of(self, cookie: str, given: Mapping[str, str]) -> Flow:
        """The sign-in that this answer ends; it is used up with that.

        Raises NotAcceptedError: it was begun elsewhere or too long ago, or is over.
        """
        if not self.began(cookie):
            raise NotAcceptedError("the browser did not begin it")
        text = cookie.rpartition(".")[0]
        flow = Flow(**json.loads(base64.urlsafe_b64decode(text)))
        if not hmac.compare_digest(given.get("state", "").encode(), self._part(flow, "state").encode()):
            raise NotAcceptedError("another state")
        now = self.clock.unix_s()
        if not (-LEEWAY_S <= now - flow.at_unix_s <= FLOW_S):
            raise NotAcceptedError("begun too long ago")
        if flow.id in self._used:
            raise NotAcceptedError("used before")
        while self._used and (now - next(iter(self._used.values())) > FLOW_S or len(self._used) >= MOST_USED):
            self._used.popitem(last=False)
        self._used[flow.id] = now
        return flow

    async def finish(self, flow: Flow, given: Mapping[str, str]) -> SignedIn:
        """Who it is, for the code that the browser brought. Raises NotAcceptedError; ApiError: 503."""
        about = await self._told()
        named = given.get("iss")  # RFC 9207: an answer of another provider
        if named != self.issuer and (named or about.get("authorization_response_iss_parameter_supported") is True):
            raise NotAcceptedError("an answer of another provider")
        if given.get("error") or not given.get("code"):
            raise NotAcceptedError(f"the provider says {plain(given.get('error')) or 'nothing'}")
        return await self._believed(await self._token(about, flow, given["code"][:2000]), flow)

    async def _token(self, about: dict[str, Any], flow: Flow, code: str) -> str:
        form = {
            "grant_type": "authorization_code", "code": code, "redirect_uri": self.redirect_uri,
            "code_verifier": self._part(flow, "verifier"),
        }  # fmt: skip
        secret, head = self._secret, {}
        known = about.get("token_endpoint_auth_methods_supported") or ["client_secret_basic"]
        if secret and "client_secret_basic" in known:
            pair = f"{quote(self.client_id, safe='')}:{quote(secret, safe='')}"  # RFC 6749, section 2.3.1
            head = {"Authorization": f"Basic {base64.b64encode(pair.encode()).decode()}"}
        else:
            form |= {"client_id": self.client_id} | ({"client_secret": secret} if secret else {})
        answer = await self._json("POST", about["token_endpoint"], data=form, headers=head)
        token = answer.get("id_token")
        if not isinstance(token, str):
            raise NotAcceptedError("no id_token")
        return token

    # ---- what is believed

    async def _believed(self, token: str, flow: Flow) -> SignedIn:
        try:
            head = jws.extract_compact(token.encode()).headers()
            key = await self._key_of(head)
            claims = parse(jws.deserialize_compact(token, key, algorithms=list(ALGORITHMS)).payload)
        except (JoseError, ValueError, TypeError, KeyError, ArithmeticError) as error:
            raise NotAcceptedError(f"the id_token's signature does not hold ({type(error).__name__})") from error
        if not isinstance(claims, dict):
            raise NotAcceptedError("the id_token holds no claims")
        self._hold(claims, flow)
        groups = claims.get(self.settings.oidc_claim)
        listed = groups if isinstance(groups, list) else [groups]
        named = claims.get("name") or claims.get("preferred_username")
        return SignedIn(
            self.issuer, claims["sub"], named if isinstance(named, str) else "",
            tuple(group for group in listed if isinstance(group, str)),
        )  # fmt: skip

    def _hold(self, claims: dict[str, Any], flow: Flow) -> None:
        """Each claim (OpenID Connect Core, section 3.1.3.7). Raises NotAcceptedError: one does not hold."""
        now, own, nonce = self.clock.unix_s(), self.client_id, claims.get("nonce")
        audience = claims.get("aud")
        several = audience if isinstance(audience, list) else [audience]
        hold(claims.get("iss") == self.issuer, "iss is another provider")
        hold(own in several, "aud is another client")
        hold(claims.get("azp", None if len(several) > 1 else own) == own, "azp is another client")
        exp, iat = number(claims.get("exp")), number(claims.get("iat"))
        hold(now < exp + LEEWAY_S, "exp is over; see that both clocks are right")
        hold(now - OLDEST_S <= iat <= now + LEEWAY_S, "iat is not now; see that both clocks are right")
        hold(not (number(claims.get("nbf", 0)) > now + LEEWAY_S), "nbf is to come")
        same = isinstance(nonce, str) and hmac.compare_digest(nonce.encode(), self._part(flow, "nonce").encode())
        hold(same, "nonce is of another sign-in")
        subject = claims.get("sub")
        hold(isinstance(subject, str) and 1 <= len(subject) <= 255 and subject.isprintable(), "sub is no subject")
        signed_in = claims.get("auth_time")
        anew = number(signed_in) >= flow.at_unix_s - LEEWAY_S
        hold(anew or (signed_in is None and not flow.session), "auth_time does not say that somebody signed in anew")

    async def _key_of(self, head: dict[str, Any]) -> Any:
        """The provider's key of this id_token; it is asked once more where it may have a new one."""
        kind = ALGORITHMS.get(head.get("alg", ""))
        if kind is None or "crit" in head:
            raise NotAcceptedError(f"the id_token is signed with {plain(head.get('alg'))}")
        for again in (False, True):
            found = [one for one in await self._key_set(again) if self._fits(one, kind, head.get("kid"))]
            if len(found) == 1:  # without a kid there is one key, or none
                return kind.import_key(found[0])
        raise NotAcceptedError("the id_token's key is not the provider's")

    def _fits(self, one: dict[str, Any], kind: Any, kid: Any) -> bool:
        if one.get("kty") != kind.key_type or one.get("use", "sig") != "sig" or (kid and one.get("kid") != kid):
            return False
        if kind is RSAKey:  # 2048 to 8192 bits: a short one is broken, a long one keeps the processor busy
            return 340 <= len(str(one.get("n"))) <= 1370
        return one.get("crv") in ("P-256", "Ed25519")

    # ---- what it says of itself

    async def _told(self) -> dict[str, Any]:
        """Its endpoints (OpenID Connect Discovery), for an hour."""
        now = self.clock.monotonic_s()
        if self._about is None or now - self._about[0] > KNOWN_S:
            try:
                told = await self._json("GET", f"{self.issuer.rstrip('/')}/.well-known/openid-configuration")
                if told.get("issuer") != self.issuer:
                    raise NotAcceptedError("it calls itself by another issuer than STIMRIG_OIDC_ISSUER")
                for name in ("authorization_endpoint", "token_endpoint", "jwks_uri"):
                    safe_address(str(told.get(name)), self.issuer)
            except (NotAcceptedError, ValueError) as error:
                log.error("%s cannot be used: %s", self.issuer, error)
                raise silent() from error
            self._about = (now, told)
        return self._about[1]

    async def _key_set(self, again: bool) -> list[dict[str, Any]]:
        now = self.clock.monotonic_s()
        age_s = math.inf if self._keys is None else now - self._keys[0]
        if age_s > (KEYS_AGAIN_S if again else KNOWN_S) or self._keys is None:
            found = (await self._json("GET", (await self._told())["jwks_uri"])).get("keys")
            if not isinstance(found, list):
                raise NotAcceptedError("the provider has no keys")
            self._keys = (now, [one for one in found[:100] if isinstance(one, dict)])
        return self._keys[1]

    async def _json(self, method: str, url: str, **more: Any) -> dict[str, Any]:
        """An object that it answers with; nobody is followed elsewhere, with a code or a secret least of all.

        Raises NotAcceptedError: it is none; ApiError: 503 nothing comes in time.
        """
        if self._tls is None:  # it reads the machine's certificates, for longer than a stop should wait
            self._tls = await asyncio.to_thread(httpx.create_ssl_context)
        head = {"Accept": "application/json", "Accept-Encoding": "identity"} | more.pop("headers", {})
        body = bytearray()
        try:
            with self._room():
                async with (
                    asyncio.timeout(ANSWER_S),
                    httpx.AsyncClient(verify=self._tls, follow_redirects=False, timeout=ANSWER_S) as http,
                    http.stream(method, url, headers=head, **more) as answer,
                ):
                    async for piece in answer.aiter_raw():
                        body += piece
                        if len(body) > ANSWER_BYTES:
                            raise NotAcceptedError("the provider's answer is too long")
        except (httpx.HTTPError, httpx.InvalidURL, OSError, TimeoutError) as error:
            log.warning("%s does not answer: %s", self.issuer, type(error).__name__)
            raise silent() from error
        if answer.status_code >= 500:
            raise silent()
        try:
            found = parse(bytes(body))
        except BadJson as error:
            raise NotAcceptedError(f"the provider's answer ({answer.status_code}) is no JSON") from error
        if answer.status_code != 200 or not isinstance(found, dict):
            said = plain(found.get("error")) if isinstance(found, dict) else ""
            raise NotAcceptedError(f"the provider answers {answer.status_code} {said}".rstrip())
        return found

    @contextmanager
    def _room(self) -> Iterator[None]:
        if self._inside >= MOST_AT_ONCE:
            raise silent()
        self._inside += 1
        try:
            yield
        finally:
            self._inside -= 1

    # ---- what the browser holds

    def _sealed(self, flow: Flow) -> str:
        text = base64.urlsafe_b64encode(json.dumps(vars(flow)).encode()).decode()
        return f"{text}.{self._mac('cookie', text)}"

    def _part(self, flow: Flow, what: str) -> str:
        """State, nonce and PKCE's verifier: nobody draws them without the key."""
        return self._mac(what, flow.id)

    def _mac(self, what: str, text: str) -> str:
        return hmac.new(self._key, f"{what} {text}".encode(), hashlib.sha256).hexdigest()


def hold(held: bool, words: str) -> None:
    """Raises NotAcceptedError where it does not."""
    if not held:
        raise NotAcceptedError(f"the id_token's {words}")


def number(value: Any) -> float:
    """A time of a claim; NaN, which holds in no comparison, for what is none."""
    known = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 2**53
    return float(value) if known else math.nan


def plain(value: Any) -> str:
    """A provider's word, as the trail and the log can hold it."""
    return "".join(sign for sign in str(value or "") if sign.isascii() and (sign.isalnum() or sign in "_-"))[:40]


def silent() -> ApiError:
    """503: all else goes on without it."""
    detail = "The provider does not answer as it should. Sign in with name and password, or with a token."
    return ApiError(503, "provider-silent", "The provider does not answer", detail)
