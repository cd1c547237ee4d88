"""Authentication: bearer tokens with scopes, and cookie sessions of browsers."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session
from starlette.requests import HTTPConnection

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.pace import Guesses, place_of
from stimrig.api.schemas.shared import Scope
from stimrig.api.store import Store, audit
from stimrig.api.store.audit import digest
from stimrig.api.store.tables import PageSession, Token

log = logging.getLogger("stimrig.api")
RECORD_S = 15.0
"""An action is not written down where the last one was so short a time ago: few pages wait for the disk."""
MOST_REMEMBERED = 1000
"""Credentials remembered for a stop while the database is unreachable."""
ROLES = {
    "clinician": [Scope.READ_LIVE, Scope.RUN_TEST, Scope.READ_MODEL, Scope.APPROVE_MODEL],
    "operator": [Scope.READ_LIVE, Scope.RUN_TEST, Scope.READ_MODEL],
    "reader": [Scope.READ_LIVE, Scope.READ_MODEL],
    "administrator": [Scope.ADMINISTER],
}
"""Scopes of each role of a user."""


@dataclass(frozen=True)
class Principal:
    """The authenticated holder of a token or session."""

    name: str  # the token's name; goes into the audit trail
    scopes: frozenset[str]  # what the token may do; ``administer`` includes everything
    token_hash: str
    participant: str | None = None  # the only one that a controller's key opens; None for everybody else
    plan: dict[str, Any] | None = None  # what trials that key may play
    page_session: PageSession | None = None  # the browser's session, however it was opened; None for a bearer token
    has_password: bool = False  # whether the session is of a person with a password, who can be asked for it again
    ended: bool = False  # whether that session has run out or was idle for too long: then it may press stop alone

    @property
    def csrf(self) -> str | None:
        """The session's CSRF token; None for a bearer token."""
        return None if self.page_session is None else self.page_session.csrf

    def may(self, scope: Scope) -> bool:
        """Return whether the scope is held."""
        return scope in self.scopes or Scope.ADMINISTER in self.scopes

    @property
    def role(self) -> str:
        """Name of the role with these scopes."""
        for scope, role in ((Scope.ADMINISTER, "administrator"), (Scope.APPROVE_MODEL, "clinician")):
            if self.may(scope):
                return role
        return "operator" if self.may(Scope.RUN_TEST) else "reader"


class Auth:
    """Issues and checks tokens and sessions; keeps only hashes: of 256 random bits, so no slow hash is needed.

    `idle_min`: a session ends after so many minutes without a person's action; 0: never by that. Actions are what
    `stimrig.api.web.guards` tells from what scripts ask for by themselves, and a live view of a running test.
    """

    def __init__(
        self, store: Store, clock: Clock, guesses: Guesses, idle_min: float = 0.0, session_hours: float = 12.0
    ) -> None:
        self.store, self.clock, self.guesses, self.session_s = store, clock, guesses, session_hours * 3600
        self.idle_s, self._retry_s = idle_min * 60, -math.inf
        self.cookie_name = f"stimrig_session_{store.secret('session-cookie').hex()[:8]}"
        """Browsers tell hosts apart, not ports: another service on this host has another name."""
        self._last_names: OrderedDict[str, str] = OrderedDict()
        self._remembering = threading.Lock()
        self._threads = ThreadPoolExecutor(8, "authentication")

    def close(self) -> None:
        """Let the threads go."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    # ---- tokens

    def issue(
        self, name: str, scopes: list[Scope], by: str, *, text: str | None = None, origin: str = "issued",
        expires_utc: str | None = None,
    ) -> str:  # fmt: skip
        """Make a token and return its text, which is shown this once."""
        text = text or f"stimrig_{secrets.token_urlsafe(32)}"
        with self.store.write() as session:
            prefix = text[:12] if origin == "issued" else "(set)"
            row = self._token(digest(text), prefix, name, scopes, origin=origin, expires_utc=expires_utc)
            session.merge(row)
            audit.write(session, self.clock.utc(), by, "issue token", name, scopes=row.scopes)
        return text

    def token_of_person(self, session: Session, name: str, scopes: list[Scope]) -> Token:
        """The token that says what a person may do; nobody holds its text."""
        token = self._token(secrets.token_hex(32), "(user)", name, scopes, origin="user")
        session.add(token)
        session.flush()
        return token

    def _token(self, hashed: str, prefix: str, name: str, scopes: list[Scope], **more: Any) -> Token:
        written = [str(scope) for scope in scopes]
        now = self.clock.utc()
        return Token(hash=hashed, prefix=prefix, name=name, scopes=written, created_utc=now, revoked=False, **more)

    def revoke(self, token_id: str, by: str) -> bool:
        """Revoke a token by its public id; False where there is none."""
        with self.store.write() as session:
            return self.revoke_within(session, token_id, by)

    def revoke_within(self, session: Session, token_id: str, by: str) -> bool:
        """Revoke a token within the caller's transaction."""
        rows = [row for row in session.scalars(select(Token)) if row.hash[:16] == token_id]
        for row in rows:
            row.revoked = True
            audit.write(session, self.clock.utc(), by, "revoke token", row.name, token=row.hash[:16])
        return bool(rows)

    def first_administrator(self, configured: str | None) -> str | None:
        """See that an administrator exists; return the new token's text if one was drawn.

        A token set from outside (``STIMRIG_ADMIN_TOKEN``) replaces the one set before it.
        """
        tokens = self.store.all(Token, Token.revoked.is_(False))
        if configured:
            for token in tokens:
                if token.origin == "settings" and token.hash != digest(configured):
                    self.revoke(token.hash[:16], "settings")
            self.issue("administrator", [Scope.ADMINISTER], "settings", text=configured, origin="settings")
            return None
        if any(Scope.ADMINISTER in token.scopes and token.origin == "issued" for token in tokens):
            return None
        return self.issue("administrator", [Scope.ADMINISTER], "first start")

    def bearer(self, text: str, address: str = "", *, forgive_age: bool = False) -> Principal:
        """The holder of a bearer token; `forgive_age`: one that ran out, or a revoked key, presses stop.

        Guesses are held to a pace by the place they come from. A token that was drawn opens all the same: nobody
        guesses its 256 bits, and others' guesses must not keep a controller out. A right token always presses stop.

        Raises ApiError: 401 unknown, revoked or expired; 429 too many that were none.
        """
        token, place = self.store.get(Token, digest(text)), place_of(address)
        if token is None:
            self.guesses.admit(("token", place))
        elif token.origin == "settings" and not forgive_age:  # a stop waits for no pace
            self.guesses.chosen_token(place)
        return self._principal(token, forgive_age)

    def _principal(self, token: Token | None, forgive_age: bool) -> Principal:
        # A controller's key always presses stop: its trial may be playing when a person revokes it.
        if token is None or (token.revoked and not (forgive_age and token.participant is not None)):
            raise unauthorized("The token is unknown or has been revoked. Ask an administrator for a new one.")
        if self._expired(token) and not forgive_age:
            raise unauthorized("The token has expired. Ask an administrator for a new one.")
        if self.creator_lost_rights(token) and not forgive_age:
            raise unauthorized("Who made this key may no longer do so. Ask a person for a new one.")
        return Principal(token.name, frozenset(token.scopes), token.hash, token.participant, token.plan)

    def _expired(self, token: Token) -> bool:
        return token.expires_utc is not None and token.expires_utc <= self.clock.utc()

    def creator_lost_rights(self, token: Token) -> bool:
        """Return whether the key's creator no longer holds the required scopes, was removed, revoked or has expired."""
        if token.made_by is None:
            return False
        creator: Token | None = self.store.get(Token, token.made_by)
        if creator is None or creator.revoked or self._expired(creator):
            return True
        needed = {Scope.APPROVE_MODEL, *token.scopes}
        return Scope.ADMINISTER not in creator.scopes and not needed <= set(creator.scopes)

    # ---- sessions of browsers

    def sign_in(self, token_text: str, address: str) -> str:
        """Open a page session for a token's holder; its cookie. Raises as `bearer` does; 403 for a controller's key."""
        principal = self.bearer(token_text, address)
        if principal.participant is not None:
            raise outside(principal.participant)
        return self.open_session(principal.token_hash, principal.name)

    def open_session(self, token_hash: str, name: str) -> str:
        """Open a page session for the holder of a token; its cookie."""
        cookie, now = secrets.token_urlsafe(32), self.clock.unix_s()
        row = PageSession(hash=digest(cookie), token_hash=token_hash, csrf=secrets.token_urlsafe(24))
        row.created_unix_s, row.expires_unix_s = now, now + self.session_s
        with self.store.write() as session:
            session.add(row)
            audit.write(session, self.clock.utc(), name, "sign in", "page")
        return cookie

    def end_sessions(self, session: Session, token_hash: str, but: str | None = None) -> str | None:
        """End the sessions of a token's holder; the one of the hash `but` goes on under a new cookie, which is given.

        Its forms stay good: they are worth nothing without the new cookie.
        """
        cookie = None
        for row in session.scalars(select(PageSession).where(PageSession.token_hash == token_hash)).all():
            if row.hash == but:
                cookie = secrets.token_urlsafe(32)
                session.add(PageSession(**row.as_dict() | {"hash": digest(cookie), "confirmed_unix_s": None}))
            session.delete(row)
        return cookie

    def sign_out(self, session_hash: str) -> None:
        """Forget a page session."""
        with self.store.write() as session:
            if (row := session.get(PageSession, session_hash)) is not None:
                session.delete(row)

    def cookie(self, cookie: str, *, forgive_age: bool = False) -> Principal:
        """The holder of a page session. `cookie`: its text; `forgive_age`: one that has ended still presses stop."""
        row: PageSession | None = self.store.get(PageSession, digest(cookie))
        ended = row is not None and self.has_ended(row)
        if row is None or (ended and not forgive_age):
            problem = unauthorized("The session has ended. Sign in again.")
            problem.extra["ended"] = ended  # False: it was signed out, or there never was one
            raise problem
        token: Token | None = self.store.get(Token, row.token_hash)
        principal = replace(self._principal(token, forgive_age), page_session=row, ended=ended)
        if token is None or token.origin != "user":
            return principal
        more = {Scope.REARM} if principal.may(Scope.RUN_TEST) else set()
        return replace(principal, has_password=True, scopes=principal.scopes | more)

    def has_ended(self, row: PageSession) -> bool:
        """Return whether a session has run out, or was idle for too long."""
        return row.expires_unix_s <= self.clock.unix_s() or 0 < self.idle_s < self._idle_for_s(row)

    def _idle_for_s(self, row: PageSession) -> float:
        return self.clock.unix_s() - (row.acted_unix_s or row.created_unix_s)

    def record_action(self, row: PageSession) -> None:
        """Record a person's action in a session that goes on. A database that takes none refuses nothing."""
        if self._idle_for_s(row) > RECORD_S and self.clock.monotonic_s() >= self._retry_s:
            try:
                with self.store.write() as session:
                    if (now := session.get(PageSession, row.hash)) is not None:
                        now.acted_unix_s = self.clock.unix_s()
            except SQLAlchemyError:
                self._retry_s = self.clock.monotonic_s() + RECORD_S
                log.exception("a person's action could not be recorded")

    # ---- requests

    async def authenticate(self, connection: HTTPConnection, **how: bool) -> Principal:
        """Run `identify` in its own threads, so that other work on the database cannot delay it."""
        return await asyncio.get_running_loop().run_in_executor(
            self._threads, partial(self.identify, connection, **how)
        )

    async def authenticate_within(self, connection: HTTPConnection, patience_s: float, **how: bool) -> Principal:
        """Run `authenticate` with a timeout. Raises also TimeoutError."""
        task = asyncio.ensure_future(self.authenticate(connection, **how))
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        async with asyncio.timeout(patience_s):
            return await asyncio.shield(task)

    def identify(self, connection: HTTPConnection, *, forgive_age: bool = False, bound: bool = False) -> Principal:
        """Return the principal of a request or a WebSocket.

        A controller's key, which is bound to a participant, is refused (403) unless the caller checks the participant
        itself (`bound`): `stimrig.api.web.guards`, and stop.
        """
        kind, text = self._credential(connection)
        key = digest(f"{kind} {text}")
        try:
            if kind == "header":
                scheme, _, token = text.partition(" ")
                if scheme.lower() != "bearer" or not token.strip():
                    raise unauthorized("Send `Authorization: Bearer <token>`.")
                address = connection.client.host if connection.client else ""
                principal = self.bearer(token.strip(), address, forgive_age=forgive_age)
            elif text:
                principal = self.cookie(text, forgive_age=forgive_age)
            else:
                raise unauthorized("Send `Authorization: Bearer <token>`, or sign in on the page.")
        except ApiError as error:
            if forgive_age and error.status == 401:  # it would not even stop
                self._last_names.pop(key, None)
            raise
        with self._remembering:  # many threads ask
            self._last_names[key] = principal.name
            self._last_names.move_to_end(key)
            while len(self._last_names) > MOST_REMEMBERED:
                self._last_names.popitem(last=False)
        if principal.participant is not None and not bound:
            raise outside(principal.participant)
        return principal

    def last_known_name(self, connection: HTTPConnection, *, on_page: bool = False) -> str | None:
        """Return the name last authenticated with this credential; it authorises a stop only.

        `on_page`: of a browser's session only; None for a bearer token, which opens no page.
        """
        kind, text = self._credential(connection)
        return None if on_page and kind == "header" else self._last_names.get(digest(f"{kind} {text}"))

    def _credential(self, connection: HTTPConnection) -> tuple[str, str]:
        header = connection.headers.get("authorization", "")
        return ("header", header) if header else ("cookie", connection.cookies.get(self.cookie_name, ""))


def unauthorized(detail: str, code: str = "unauthorized", title: str = "Not signed in") -> ApiError:
    """A 401 with the challenge that RFC 9110 asks for."""
    problem = ApiError(401, code, title, detail)
    problem.headers["WWW-Authenticate"] = 'Bearer realm="stimrig"'
    return problem


def outside(participant: str | None) -> ApiError:
    """403 for whatever a key does not open; the same for what is another's and for what is not there."""
    detail = (
        f"This key is for one participant, {participant}, and one day: the approved model, predictions and widths, "
        "live signals and recordings of tests, and trials within the plan. This is not among them."
    )
    return ApiError(403, "outside-key", "This key does not open it", detail)
