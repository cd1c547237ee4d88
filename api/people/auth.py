"""Authentication: bearer tokens with scopes, and cookie sessions of browsers."""

from __future__ import annotations

import asyncio
import secrets
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session
from starlette.requests import HTTPConnection

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.pace import Guesses, place_of
from stimrig.api.schemas.shared import Scope
from stimrig.api.store import Store, audit
from stimrig.api.store.audit import digest
from stimrig.api.store.tables import Confirmation, PageSession, Token

LOCKED = ("locked", "This page is locked")
"""Code and title of the problem that a locked session meets."""
MOST_SEEN = 1000
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
    csrf: str | None = None  # the session's CSRF token; None for a bearer token
    session_hash: str | None = None
    """The session of a person with a password; None for tokens, which have none to ask for again."""
    page_session: PageSession | None = None  # the browser's session, however it was opened; None for a bearer token
    locked: bool = False  # whether that session waits to be unlocked: then it may press stop, and nothing else
    participant: str | None = None  # the only one that a controller's key opens; None for everybody else
    plan: dict[str, Any] | None = None  # what trials that key may play
    token_hash: str = ""  # the token's

    def may(self, scope: Scope) -> bool:
        """Return whether the scope is held."""
        return scope in self.scopes or Scope.ADMINISTER in self.scopes

    @property
    def role(self) -> str:
        """Name of the role with these scopes."""
        if self.may(Scope.ADMINISTER):
            return "administrator"
        if self.may(Scope.APPROVE_MODEL):
            return "clinician"
        return "operator" if self.may(Scope.RUN_TEST) else "reader"


class Auth:
    """Issues and checks tokens and sessions; keeps only hashes: of 256 random bits, so no slow hash is needed."""

    def __init__(
        self, store: Store, clock: Clock, guesses: Guesses, idle: IdleLock, session_hours: float = 12.0
    ) -> None:
        self.store, self.clock, self.guesses, self.session_s = store, clock, guesses, session_hours * 3600
        self.idle = idle
        self.cookie_name = f"stimrig_session_{store.secret('session-cookie').hex()[:8]}"
        """Browsers tell hosts apart, not ports: another service on this host has another name."""
        self._last_names: OrderedDict[str, str] = OrderedDict()
        self._remembering = threading.Lock()
        self._threads = ThreadPoolExecutor(8, "who-asks")

    def issue(
        self, name: str, scopes: list[Scope], by: str, *, text: str | None = None, origin: str = "issued",
        expires_utc: str | None = None,
    ) -> str:  # fmt: skip
        """Make a token and return its text, which is shown this once."""
        text = text or f"stimrig_{secrets.token_urlsafe(32)}"
        now = self.clock.utc()
        with self.store.write() as session:
            row = Token(hash=digest(text), prefix=text[:12] if origin == "issued" else "(set)", name=name)
            row.scopes, row.created_utc, row.origin = [str(scope) for scope in scopes], now, origin
            row.expires_utc, row.revoked = expires_utc, False
            session.merge(row)
            audit.write(session, now, by, "issue token", name, scopes=row.scopes)
        return text

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

    def close(self) -> None:
        """Let the threads go."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def first_administrator(self, configured: str | None) -> str | None:
        """See that an administrator exists; return the new token's text if one was drawn.

        A token set from outside (``STIMRIG_ADMIN_TOKEN``) replaces the one set before it.
        """
        if configured:
            self._revoke_set_tokens(current_hash=digest(configured))
            self.issue("administrator", [Scope.ADMINISTER], "settings", text=configured, origin="settings")
            return None
        tokens = self.store.all(Token, Token.revoked.is_(False))
        if any(Scope.ADMINISTER in token.scopes and token.origin == "issued" for token in tokens):
            return None
        return self.issue("administrator", [Scope.ADMINISTER], "first start")

    def _revoke_set_tokens(self, current_hash: str) -> None:
        with self.store.write() as session:
            old = select(Token).where(Token.origin == "settings", Token.hash != current_hash, Token.revoked.is_(False))
            for token in session.scalars(old).all():
                self.revoke_within(session, token.hash[:16], "settings")

    def bearer(self, text: str, address: str = "", *, forgive_age: bool = False) -> Principal:
        """The holder of a bearer token; `forgive_age`: one that ran out, or a revoked key, presses stop.

        Guesses are held to a pace by the place they come from. A token that was drawn opens all the same: nobody
        guesses its 256 bits, and others' guesses must not keep a controller out. A right token always presses stop.

        Raises ApiError: 401 unknown, revoked or expired; 429 too many that were none.
        """
        token, place = self.store.get(Token, digest(text)), place_of(address)
        if token is None:
            self.guesses.unknown_token(place)
        elif token.origin == "settings" and not forgive_age:  # a stop waits for no pace
            self.guesses.chosen_token(token.hash, place)
        return self._principal(token, forgive_age=forgive_age)

    def _principal(self, token: Token | None, csrf: str | None = None, *, forgive_age: bool = False) -> Principal:
        # A controller's key always presses stop: its trial may be playing when a person revokes it.
        if token is None or (token.revoked and not (forgive_age and token.participant is not None)):
            raise unauthorized("The token is unknown or has been revoked. Ask an administrator for a new one.")
        if token.expires_utc is not None and token.expires_utc <= self.clock.utc() and not forgive_age:
            raise unauthorized("The token has expired. Ask an administrator for a new one.")
        if self.fallen(token) and not forgive_age:
            raise unauthorized("Who made this key may no longer do so. Ask a person for a new one.")
        return Principal(
            token.name, frozenset(token.scopes), csrf, participant=token.participant, plan=token.plan,
            token_hash=token.hash,
        )  # fmt: skip

    def fallen(self, token: Token) -> bool:
        """Return whether the key's creator no longer holds the required scopes.

        Also true once the creator was removed, or the creating token was revoked or expired.
        """
        if token.made_by is None:
            return False
        maker: Token | None = self.store.get(Token, token.made_by)
        if maker is None or maker.revoked or (
            maker.expires_utc is not None and not maker.expires_utc > self.clock.utc()
        ):  # fmt: skip
            return True
        needed = {Scope.APPROVE_MODEL, *token.scopes}
        return Scope.ADMINISTER not in maker.scopes and not needed <= set(maker.scopes)

    def sign_in(self, token_text: str, address: str) -> str:
        """Open a page session for a token's holder; its cookie. Raises as `bearer` does; 403 for a controller's key."""
        principal = self.bearer(token_text, address)
        if principal.participant is not None:
            raise outside(principal.participant)
        return self.open_session(digest(token_text), principal.name)

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

    def token_of_person(self, session: Session, name: str, scopes: list[Scope]) -> Token:
        """The token that says what a person may do; nobody holds its text."""
        token = Token(hash=secrets.token_hex(32), prefix="(user)", name=name, origin="user", revoked=False)
        token.scopes, token.created_utc = [str(scope) for scope in scopes], self.clock.utc()
        session.add(token)
        session.flush()
        return token

    def end_sessions(self, session: Session, token_hash: str, but: str | None = None) -> str | None:
        """End the sessions of a token's holder; the one of the hash `but` goes on under a new cookie, which is given.

        Its forms stay good: they are worth nothing without the new cookie.
        """
        cookie = None
        for row in session.scalars(select(PageSession).where(PageSession.token_hash == token_hash)).all():
            if row.hash == but:
                cookie = secrets.token_urlsafe(32)
                session.add(PageSession(**{**row.as_dict(), "hash": digest(cookie)}))
            session.execute(delete(Confirmation).where(Confirmation.session_hash == row.hash))
            session.delete(row)
        return cookie

    def sign_out(self, cookie: str) -> None:
        """Forget a page session."""
        with self.store.write() as session:
            row = session.get(PageSession, digest(cookie))
            if row is not None:
                session.delete(row)

    def cookie(self, cookie: str, *, forgive_age: bool = False, forgive_lock: bool = False) -> Principal:
        """The holder of a page session.

        `cookie`: its text; `forgive_age`: a session that ran out, or that is locked, still presses stop;
        `forgive_lock`: one that is locked may be unlocked, or ended.
        """
        row = self.store.get(PageSession, digest(cookie))
        if row is None or (row.expires_unix_s <= self.clock.unix_s() and not forgive_age):
            raise unauthorized("The session has ended. Sign in again.")
        locked = self.idle.locked(row)
        if locked and not (forgive_age or forgive_lock):
            raise unauthorized(
                "Enter the password on the page /locked, or send it to POST /v1/sessions/unlock.", *LOCKED
            )
        token: Token | None = self.store.get(Token, row.token_hash)
        principal = replace(self._principal(token, row.csrf, forgive_age=forgive_age), page_session=row, locked=locked)
        if token is None or token.origin != "user":
            return principal
        more = {Scope.REARM} if principal.may(Scope.RUN_TEST) else set()
        return replace(principal, session_hash=row.hash, scopes=principal.scopes | more)

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

    def identify(
        self, connection: HTTPConnection, *, forgive_age: bool = False, forgive_lock: bool = False, bound: bool = False
    ) -> Principal:
        """Return the principal of a request or a WebSocket.

        A controller's key, which is bound to a participant, is refused (403) unless the caller checks the participant
        itself (`bound`): `stimrig.api.web.guards`, and stop.
        """
        try:
            principal = self._identify(connection, forgive_age, forgive_lock)
        except ApiError as error:
            if forgive_age and error.status == 401:  # it would not even stop
                self._forget(connection)
            raise
        self._remember(connection, principal.name)
        if principal.participant is not None and not bound:
            raise outside(principal.participant)
        return principal

    def _remember(self, connection: HTTPConnection, name: str) -> None:
        with self._remembering:  # many threads ask
            self._last_names[self._credential(connection)] = name
            self._last_names.move_to_end(self._credential(connection))
            while len(self._last_names) > MOST_SEEN:
                self._last_names.popitem(last=False)

    def _forget(self, connection: HTTPConnection) -> None:
        with self._remembering:
            self._last_names.pop(self._credential(connection), None)

    def last_known_name(self, connection: HTTPConnection) -> str | None:
        """Return the name last authenticated with this credential; it authorises a stop only."""
        return self._last_names.get(self._credential(connection))

    def last_known_name_on_page(self, connection: HTTPConnection) -> str | None:
        """Return `last_known_name` of a browser's session; None for a bearer token, which opens no page."""
        return None if connection.headers.get("authorization") else self.last_known_name(connection)

    def _identify(self, connection: HTTPConnection, forgive_age: bool, forgive_lock: bool) -> Principal:
        header = connection.headers.get("authorization", "")
        if header:
            kind, _, text = header.partition(" ")
            if kind.lower() != "bearer" or not text.strip():
                raise unauthorized("Send `Authorization: Bearer <token>`.")
            address = connection.client.host if connection.client else ""
            return self.bearer(text.strip(), address, forgive_age=forgive_age)
        cookie = connection.cookies.get(self.cookie_name)
        if cookie:
            return self.cookie(cookie, forgive_age=forgive_age, forgive_lock=forgive_lock)
        raise unauthorized("Send `Authorization: Bearer <token>`, or sign in on the page.")

    def _credential(self, connection: HTTPConnection) -> str:
        header = connection.headers.get("authorization", "")
        return digest(f"header {header}" if header else f"cookie {connection.cookies.get(self.cookie_name, '')}")


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


FLUSH_S = 15.0
"""Interval at which times of last actions are stored; a killed process loses at most that much."""


class IdleLock:
    """Locks idle sessions, which then need the password again.

    Only a person's actions count, as `stimrig.api.web.guards` tells them from what scripts ask for by themselves. Times
    of actions are kept in memory and written down now and then, so that no page waits for the disk; a lock holds over a
    restart.

    `store`: holds the sessions. `clock`: idle times are measured on it. `after_min`: a session locks after so many
    minutes without an action; 0: never by itself.
    """

    def __init__(self, store: Store, clock: Clock, after_min: float) -> None:
        self.store, self.clock, self.after_s = store, clock, after_min * 60
        self._acted: dict[str, float] = {}
        self._locked_by_hand: set[str] = set()
        self._lock = threading.Lock()

    def locked(self, row: PageSession) -> bool:
        """Return whether this session is locked."""
        if row.locked_unix_s is not None:
            return True
        return bool(self.after_s) and self.clock.unix_s() - self._last(row) > self.after_s

    def left_s(self, row: PageSession) -> float | None:
        """Until it locks; None where it never does."""
        return max(0.0, self._last(row) + self.after_s - self.clock.unix_s()) if self.after_s else None

    def _last(self, row: PageSession) -> float:
        return max(row.acted_unix_s or row.created_unix_s, self._acted.get(row.hash, 0.0))

    def acted(self, session_hash: str) -> None:
        """Record a person's action in a session that is not locked."""
        with self._lock:
            self._acted[session_hash] = self.clock.unix_s()

    def watches(self, session_hash: str) -> None:
        """Record that a live view of a running test is open, which delays the idle lock but not a manual one."""
        if session_hash not in self._locked_by_hand:
            self.acted(session_hash)

    def lock(self, session_hash: str, by: str) -> None:
        """Lock it now."""
        self._locked_by_hand.add(session_hash)
        self._change(session_hash, self.clock.unix_s(), by, "lock")

    def unlock(self, session_hash: str, by: str) -> None:
        """The person is back."""
        self._change(session_hash, None, by, "unlock")
        self._locked_by_hand.discard(session_hash)

    def _change(self, session_hash: str, locked_unix_s: float | None, by: str, action: str) -> None:
        with self.store.write() as session:
            row = session.get(PageSession, session_hash)
            if row is not None:
                row.locked_unix_s, row.acted_unix_s = locked_unix_s, self.clock.unix_s()
                audit.write(session, self.clock.utc(), by, action, "page")

    def flush(self) -> None:
        """Write the times of the last actions down."""
        with self._lock:
            acted = dict(self._acted)
        if not acted:
            return
        with self.store.write() as session:
            for row in session.scalars(select(PageSession).where(PageSession.hash.in_(acted))):
                row.acted_unix_s = max(row.acted_unix_s or 0.0, acted[row.hash])
        with self._lock:  # what came meanwhile stays for the next time
            self._acted = {key: at_s for key, at_s in self._acted.items() if acted.get(key) != at_s}
