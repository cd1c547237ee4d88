"""Who may do what: bearer tokens with scopes, and a cookie session for the page's plain forms."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from fastapi import Request
from sqlalchemy import select
from starlette.requests import HTTPConnection

from api import audit
from api.clock import Clock
from api.errors import ApiError
from api.store import Store
from api.store.tables import PageSession, Token

COOKIE = "stimrig_session"
SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}


class Scope(StrEnum):
    """What a token may be used for."""

    READ_LIVE = "read-live"
    RUN_TEST = "run-test"
    APPROVE_MODEL = "approve-model"
    READ_MODEL = "read-model"
    ADMINISTER = "administer"


@dataclass(frozen=True)
class Principal:
    """Who is asking.

    Parameters
    ----------
    name : str
        The token's name; goes into the audit trail.
    scopes : frozenset of str
        What the token may do; ``administer`` includes everything.
    csrf : str or None
        The session's CSRF token; None for a bearer token.
    session_hash : str or None
        The session of a person with a password; None for tokens, which have none to ask for again.
    """

    name: str
    scopes: frozenset[str]
    csrf: str | None = None
    session_hash: str | None = None

    def may(self, scope: Scope) -> bool:
        """Whether the scope is held."""
        return scope in self.scopes or Scope.ADMINISTER in self.scopes

    @property
    def role(self) -> str:
        """What a person calls these scopes."""
        if self.may(Scope.ADMINISTER):
            return "administrator"
        if self.may(Scope.APPROVE_MODEL):
            return "clinician"
        return "operator" if self.may(Scope.RUN_TEST) else "reader"


class Auth:
    """Issues and checks tokens and sessions; keeps only hashes."""

    def __init__(self, store: Store, clock: Clock, session_hours: float = 12.0) -> None:
        self.store, self.clock, self.session_s = store, clock, session_hours * 3600
        self._known: dict[str, Token] = {}

    def issue(self, name: str, scopes: list[Scope], by: str, *, text: str | None = None, origin: str = "issued",
              expires_utc: str | None = None) -> str:  # fmt: skip
        """Make a token and return its text, which is shown this once."""
        text = text or f"stimrig_{secrets.token_urlsafe(32)}"
        now = self.clock.utc()
        with self.store.write() as session:
            row = Token(hash=digest(text), prefix=text[:12] if origin == "issued" else "(set)", name=name)
            row.scopes, row.created_utc, row.origin = [str(scope) for scope in scopes], now, origin
            row.expires_utc, row.revoked = expires_utc, False
            session.merge(row)
            audit.write(session, now, by, "issue token", name, scopes=row.scopes)
        self._known.clear()
        return text

    def revoke(self, token_id: str, by: str) -> bool:
        """Revoke a token by its public id; False where there is none."""
        with self.store.write() as session:
            found = [row for row in session.scalars(select(Token)) if row.hash[:16] == token_id]
            for row in found:
                row.revoked = True
                audit.write(session, self.clock.utc(), by, "revoke token", row.name)
        self._known.clear()
        return bool(found)

    def first_administrator(self, configured: str | None) -> str | None:
        """See that an administrator exists; return the new token's text if one was drawn.

        A token set from outside (``STIMRIG_ADMIN_TOKEN``) replaces the one set before it.
        """
        if configured:
            self._revoke_set_tokens(keep=digest(configured))
            self.issue("administrator", [Scope.ADMINISTER], "settings", text=configured, origin="settings")
            return None
        tokens = self.store.all(Token, Token.revoked.is_(False))
        if any(Scope.ADMINISTER in token.scopes and token.origin == "issued" for token in tokens):
            return None
        return self.issue("administrator", [Scope.ADMINISTER], "first start")

    def _revoke_set_tokens(self, keep: str) -> None:
        with self.store.write() as session:
            for token in session.scalars(select(Token).where(Token.origin == "settings", Token.hash != keep)):
                token.revoked = True
        self._known.clear()

    def bearer(self, text: str) -> Principal:
        """The holder of a bearer token.

        Raises
        ------
        ApiError
            401: unknown, revoked or expired.
        """
        return self._principal(self._token(digest(text)))

    def _token(self, token_hash: str) -> Token | None:
        """A token's row; kept in memory, since a controller asks often, and forgotten at every change."""
        found = self._known.get(token_hash)
        if found is None:
            found = self.store.get(Token, token_hash)
            if found is not None:
                self._known[token_hash] = found
        return found

    def _principal(self, token: Token | None, csrf: str | None = None) -> Principal:
        if token is None or token.revoked:
            raise unauthorized("The token is unknown or has been revoked. Ask an administrator for a new one.")
        if token.expires_utc is not None and token.expires_utc <= self.clock.utc():
            raise unauthorized("The token has expired. Ask an administrator for a new one.")
        return Principal(token.name, frozenset(token.scopes), csrf)

    def sign_in(self, token_text: str) -> str:
        """Open a page session; return its cookie."""
        return self.open_session(digest(token_text), self.bearer(token_text).name)

    def open_session(self, token_hash: str, name: str) -> str:
        """Open a page session for the holder of a token; its cookie."""
        cookie, now = secrets.token_urlsafe(32), self.clock.unix_s()
        with self.store.write() as session:
            session.add(
                PageSession(
                    hash=digest(cookie),
                    token_hash=token_hash,
                    csrf=secrets.token_urlsafe(24),
                    created_unix_s=now,
                    expires_unix_s=now + self.session_s,
                )
            )
            audit.write(session, self.clock.utc(), name, "sign in", "page")
        return cookie

    def sign_out(self, cookie: str) -> None:
        """Forget a page session."""
        with self.store.write() as session:
            row = session.get(PageSession, digest(cookie))
            if row is not None:
                session.delete(row)

    def cookie(self, cookie: str, *, forgive_age: bool = False) -> Principal:
        """The holder of a page session; `forgive_age` lets a session that ran out still press stop."""
        row = self.store.get(PageSession, digest(cookie))
        if row is None or (row.expires_unix_s <= self.clock.unix_s() and not forgive_age):
            raise unauthorized("The session has ended. Sign in again.")
        token = self._token(row.token_hash)
        principal = self._principal(token, row.csrf)
        return replace(principal, session_hash=row.hash) if token and token.origin == "user" else principal

    def identify(self, connection: HTTPConnection, *, forgive_age: bool = False) -> Principal:
        """Who stands behind a request or a WebSocket."""
        header = connection.headers.get("authorization", "")
        if header:
            kind, _, text = header.partition(" ")
            if kind.lower() != "bearer" or not text.strip():
                raise unauthorized("Send `Authorization: Bearer <token>`.")
            return self.bearer(text.strip())
        cookie = connection.cookies.get(COOKIE)
        if cookie:
            return self.cookie(cookie, forgive_age=forgive_age)
        raise unauthorized("Send `Authorization: Bearer <token>`, or sign in on the page.")


def digest(text: str) -> str:
    """SHA-256 in hex; the tokens are drawn from 256 random bits, so no slow hash is needed."""
    return hashlib.sha256(text.encode()).hexdigest()


def unauthorized(detail: str, code: str = "unauthorized", title: str = "Not signed in") -> ApiError:
    """A 401 with the challenge that RFC 9110 asks for."""
    problem = ApiError(401, code, title, detail)
    problem.headers["WWW-Authenticate"] = 'Bearer realm="stimrig"'
    return problem


def require(scope: Scope) -> Callable[[Request], Awaitable[Principal]]:
    """A dependency: the principal, if the scope is held and a session's form carries its CSRF token."""

    async def check(request: Request) -> Principal:
        principal = request.app.state.context.auth.identify(request)
        if not principal.may(scope):
            detail = f"This needs the scope {scope}; {principal.name} holds {', '.join(sorted(principal.scopes))}."
            raise ApiError(403, "forbidden", "Not allowed", detail)
        await check_csrf(request, principal)
        if scope is Scope.APPROVE_MODEL and request.method not in SAFE_METHODS:
            await request.app.state.context.people.confirmed(request, principal)
        return principal

    check.__name__ = f"require_{scope.name.lower()}"
    return check


async def anyone_signed_in(request: Request) -> Principal:
    """A dependency: anyone with a valid token or session."""
    principal = request.app.state.context.auth.identify(request)
    await check_csrf(request, principal)
    return principal


async def anyone_who_may_stop(request: Request) -> Principal:
    """A dependency for stop: a session that ran out, or a form gone stale, must not keep a person from stopping.

    The cookie is SameSite=Strict, so another site cannot press the button either way.
    """
    return request.app.state.context.auth.identify(request, forgive_age=True)


async def check_csrf(request: Request, principal: Principal) -> None:
    """Refuse a session's write whose form or header does not carry the session's CSRF token."""
    if principal.csrf is None or request.method in SAFE_METHODS:
        return
    sent: Any = request.headers.get("x-csrf-token")
    if sent is None and "form" in request.headers.get("content-type", ""):
        sent = (await request.form()).get("csrf")
    if not isinstance(sent, str) or not hmac.compare_digest(sent.encode(), principal.csrf.encode()):
        raise ApiError(403, "csrf", "The form is out of date", "Load the page again and repeat what you did.")
