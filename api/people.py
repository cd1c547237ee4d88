"""People with passwords: argon2id, sign-in held to a pace, the password once more before a model is approved."""

from __future__ import annotations

import asyncio
import secrets
import threading
from typing import Any

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError
from fastapi import Request
from sqlalchemy import select

from api import audit
from api.auth import Auth, Principal, Scope, unauthorized
from api.clock import Clock
from api.errors import ApiError, NotFoundError
from api.store import Store
from api.store.tables import Confirmation, Token, User

CONFIRMED_S = 120.0
"""How long a password given once more is good for one approval."""
FREE_TRIES, LONGEST_WAIT_S = 5, 300.0
MOST_KEYS = 10_000


class Pace:
    """Wrong passwords slow the next try down: five are free, then each doubles the wait, up to five minutes."""

    def __init__(self, clock: Clock, free: int = FREE_TRIES) -> None:
        self.clock, self.free = clock, free
        self._failed: dict[str, tuple[int, float]] = {}
        self._lock = threading.Lock()

    def admit(self, *keys: str) -> None:
        """Count a try; it is forgotten if it proves right.

        Raises
        ------
        ApiError
            429 with `Retry-After`.
        """
        now = self.clock.monotonic_s()
        with self._lock:
            wait_s = max((self._failed[key][1] - now for key in keys if key in self._failed), default=0.0)
            if wait_s > 0:
                problem = ApiError(429, "too-many-tries", "Too many wrong passwords", f"Try again in {wait_s:.0f} s.")
                problem.headers["Retry-After"] = str(int(wait_s) + 1)
                raise problem
            if len(self._failed) > MOST_KEYS:
                self._failed.clear()
            for key in keys:
                count = self._failed.get(key, (0, 0.0))[0] + 1
                over = count - self.free
                self._failed[key] = (count, now + min(LONGEST_WAIT_S, 2.0 ** min(over, 20)) if over >= 0 else 0.0)

    def forget(self, *keys: str) -> None:
        """The password was right."""
        with self._lock:
            for key in keys:
                self._failed.pop(key, None)


class People:
    """Users of the page."""

    def __init__(self, store: Store, clock: Clock, auth: Auth) -> None:
        self.store, self.clock, self.auth = store, clock, auth
        self.pace = Pace(clock)
        self.hasher = PasswordHasher()  # argon2id, RFC 9106's parameters for little memory
        self._nobody = self.hasher.hash(secrets.token_hex(16))
        self._at_once = threading.Semaphore(2)  # each costs 64 MB

    def add(self, name: str, password: str, scopes: list[Scope], by: str) -> User:
        """A new person.

        Raises
        ------
        ApiError
            409: the name is taken.
        """
        hashed, now = self._hash(password), self.clock.utc()
        with self.store.write() as session:
            if session.get(User, name) is not None:
                raise ApiError(409, "exists", "The name is taken", f"User {name!r} exists. Take another name.")
            token = Token(hash=secrets.token_hex(32), prefix="(user)", name=name, origin="user", revoked=False)
            token.scopes, token.created_utc = [str(scope) for scope in scopes], now
            session.add(token)
            session.flush()
            row = User(name=name, password_hash=hashed, token_hash=token.hash, created_utc=now, changed_utc=now)
            session.add(row)
            audit.write(session, now, by, "add user", name, scopes=token.scopes)
        return row

    def sign_in(self, name: str, password: str, address: str) -> str:
        """Open a session; its cookie.

        Raises
        ------
        ApiError
            401 wrong name or password (not said which); 429 too many tries.
        """
        keys = (f"name {name}", f"address {address}")
        self.pace.admit(*keys)
        row = self.store.get(User, name)
        if not self._verify(row.password_hash if row else self._nobody, password) or row is None:
            self._note(name[:80], "sign in refused", address=address)
            raise unauthorized("Name and password do not match.")
        token = self.store.get(Token, row.token_hash)
        if token.revoked:
            raise unauthorized("This user has been removed. Ask an administrator.")
        self.pace.forget(*keys)
        if self.hasher.check_needs_rehash(row.password_hash):
            self._store_password(name, self._hash(password))
        return self.auth.open_session(token.hash, name)

    def sign_in_with_token(self, text: str, address: str) -> str:
        """Open a session for a token's holder; its cookie. Held to the same pace: a token that was set may be weak.

        Raises
        ------
        ApiError
            401 unknown, revoked or expired; 429 too many tries.
        """
        self.pace.admit(f"address {address}")
        cookie = self.auth.sign_in(text)
        self.pace.forget(f"address {address}")
        return cookie

    def any(self) -> bool:
        """Whether there is anybody who could sign in with a password."""
        return bool(self.store.all(User, limit=1))

    def confirm(self, principal: Principal, password: str) -> None:
        """The password once more: good for one approval within two minutes.

        Raises
        ------
        ApiError
            401 wrong password; 409 signed in with a token; 429 too many tries.
        """
        if principal.session_hash is None:
            raise ApiError(409, "no-password", "There is no password to confirm", "Signed in with a token.")
        key = f"name {principal.name}"
        self.pace.admit(key)
        row = self.store.get(User, principal.name)
        if row is None or not self._verify(row.password_hash, password):
            self._note(principal.name, "confirmation refused")
            detail = "Nothing was decided. Go back and give it once more."
            raise unauthorized(detail, "wrong-password", "The password does not match")
        self.pace.forget(key)
        with self.store.write() as session:
            session.merge(Confirmation(session_hash=principal.session_hash, at_unix_s=self.clock.unix_s()))

    async def confirmed(self, request: Request, principal: Principal) -> None:
        """Refuse an approval of a person who has not given the password again; a form may carry it in `password`.

        Raises
        ------
        ApiError
            403: the password is asked for.
        """
        if principal.session_hash is None:
            return
        if "form" in request.headers.get("content-type", ""):
            password = (await request.form()).get("password")
            if isinstance(password, str) and password:
                await asyncio.to_thread(self.confirm, principal, password)
        if not await asyncio.to_thread(self._use_confirmation, principal.session_hash):
            detail = (
                "Approving needs your password once more: as `password` in the form, or by POST /v1/sessions/confirm "
                f"at most {CONFIRMED_S:.0f} s before."
            )
            raise ApiError(403, "confirm-password", "Please confirm with your password", detail)

    def _use_confirmation(self, session_hash: str) -> bool:
        with self.store.write() as session:
            row = session.get(Confirmation, session_hash)
            if row is None:
                return False
            session.delete(row)
            return 0 <= self.clock.unix_s() - row.at_unix_s <= CONFIRMED_S

    def change_password(self, name: str, password: str, by: str) -> None:
        """A new password; the person's sessions end."""
        if self.store.get(User, name) is None:
            raise NotFoundError("user", name, "GET /v1/users lists them.")
        self._store_password(name, self._hash(password))
        self._end_sessions(name)
        self._note(by, "change password", of=name)

    def remove(self, name: str, by: str) -> None:
        """Let nobody sign in under this name any more; the name stays taken, as the audit trail speaks of it."""
        row = self.store.get(User, name)
        if row is None:
            raise NotFoundError("user", name, "GET /v1/users lists them.")
        self.auth.revoke(row.token_hash[:16], by)
        self._end_sessions(name)

    def public(self) -> list[dict[str, Any]]:
        """All users, without their hashes."""
        found = []
        for row in self.store.all(User, order=User.name):
            token = self.store.get(Token, row.token_hash)
            found.append(
                {"name": row.name, "scopes": token.scopes, "removed": token.revoked, "created_utc": row.created_utc}
            )
        return found

    def _end_sessions(self, name: str) -> None:
        from api.store.tables import PageSession

        row = self.store.get(User, name)
        with self.store.write() as session:
            for held in session.scalars(select(PageSession).where(PageSession.token_hash == row.token_hash)):
                session.delete(held)

    def _store_password(self, name: str, hashed: str) -> None:
        with self.store.write() as session:
            row = session.get(User, name)
            assert row is not None
            row.password_hash, row.changed_utc = hashed, self.clock.utc()

    def _note(self, who: str, action: str, **detail: Any) -> None:
        with self.store.write() as session:
            audit.write(session, self.clock.utc(), who, action, "page", **detail)

    def _hash(self, password: str) -> str:
        with self._at_once:
            return self.hasher.hash(password)

    def _verify(self, hashed: str, password: str) -> bool:
        with self._at_once:
            try:
                return self.hasher.verify(hashed, password)
            except (Argon2Error, InvalidHashError):
                return False
