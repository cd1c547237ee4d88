"""People with passwords: signing in, the password once more before a model is approved, new passwords."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import Request
from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from api.clock import Clock
from api.errors import ApiError, NotFoundError
from api.people.auth import Auth, Principal, Scope, unauthorized
from api.people.pace import Guesses, place_of
from api.people.passwords import Passwords
from api.store import Store, audit
from api.store.tables import Confirmation, KnownPlace, Token, User

CONFIRMED_S = 120.0
"""How long a password given once more is good for one approval."""
MOST_PLACES = 20
"""So many places of a person are remembered."""


class People:
    """Users of the page."""

    def __init__(self, store: Store, clock: Clock, auth: Auth, guesses: Guesses) -> None:
        self.store, self.clock, self.auth, self.guesses = store, clock, auth, guesses
        self.passwords = Passwords()

    async def add(self, name: str, password: str, scopes: list[Scope], by: str) -> User:
        """A new person.

        Raises
        ------
        ApiError
            409: the name is taken.
        """
        return await asyncio.to_thread(self._add, name, await self.passwords.hash(password), scopes, by)

    def _add(self, name: str, hashed: str, scopes: list[Scope], by: str) -> User:
        now = self.clock.utc()
        with self.store.write() as session:
            if session.get(User, name) is not None:
                raise ApiError(409, "exists", "The name is taken", f"User {name!r} exists. Take another name.")
            token = self.auth.token_of_person(session, name, scopes)
            row = User(name=name, password_hash=hashed, token_hash=token.hash, created_utc=now, changed_utc=now)
            session.add(row)
            audit.write(session, now, by, "add user", name, scopes=token.scopes)
        return row

    async def sign_in(self, name: str, password: str, address: str) -> str:
        """Open a session; its cookie.

        Raises
        ------
        ApiError
            401 wrong name or password (not said which); 429 too many tries.
        """
        place = place_of(address)
        row, known = await asyncio.to_thread(self._look_up, name, place)
        with self.passwords.room(known) as lane:
            self.guesses.password(name, place, known)
            right = await self.passwords.verify(lane, row.password_hash if row else None, password)
        if not right or row is None:
            await asyncio.to_thread(self._note, name[:80], "sign in refused", address=address)
            raise unauthorized("Name and password do not match.")
        token: Token = await asyncio.to_thread(self.store.get, Token, row.token_hash)
        if token.revoked:
            raise unauthorized("This user has been removed. Ask an administrator.")
        self.guesses.password_was_right(name, place, known)
        if self.passwords.hasher.check_needs_rehash(row.password_hash):
            await asyncio.to_thread(self._store_password, name, await self.passwords.hash(password))
        await asyncio.to_thread(self._remember, name, place)
        return await asyncio.to_thread(self.auth.open_session, token.hash, name)

    def _look_up(self, name: str, place: str) -> tuple[User | None, bool]:
        with self.store.read() as session:
            return session.get(User, name), session.get(KnownPlace, (name, place)) is not None

    def _remember(self, name: str, place: str) -> None:
        with self.store.write() as session:
            session.merge(KnownPlace(name=name, place=place, at_unix_s=self.clock.unix_s()))
            session.flush()
            newest = select(KnownPlace).where(KnownPlace.name == name).order_by(KnownPlace.at_unix_s.desc())
            for old in session.scalars(newest.offset(MOST_PLACES)).all():
                session.delete(old)

    def any(self) -> bool:
        """Whether there is anybody who could sign in with a password."""
        return bool(self.store.all(User, limit=1))

    async def confirm(self, principal: Principal, password: str) -> None:
        """The password once more: good for one approval within two minutes.

        Raises
        ------
        ApiError
            401 wrong password; 409 signed in with a token; 429 too many tries.
        """
        held = principal.session_hash
        if held is None:
            raise ApiError(409, "no-password", "There is no password to confirm", "Signed in with a token.")
        row: User | None = await asyncio.to_thread(self.store.get, User, principal.name)
        with self.passwords.room(known=True) as lane:
            self.guesses.confirmation(held)
            right = await self.passwords.verify(lane, row.password_hash if row else None, password)
        if not right:
            await asyncio.to_thread(self._note, principal.name, "confirmation refused")
            detail = "Nothing was decided. Go back and enter it again."
            raise unauthorized(detail, "wrong-password", "The password does not match")
        self.guesses.confirmation_was_right(held)
        await asyncio.to_thread(self._confirm, held)

    def _confirm(self, session_hash: str) -> None:
        with self.store.write() as session:
            session.merge(Confirmation(session_hash=session_hash, at_unix_s=self.clock.unix_s()))

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
                await self.confirm(principal, password)
        if not await asyncio.to_thread(self._use_confirmation, principal.session_hash):
            detail = (
                "To approve, enter your password again: as `password` in the form, or by POST /v1/sessions/confirm "
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

    async def change_password(self, name: str, password: str, who: Principal) -> str | None:
        """A new password. The person's sessions end; the one that made the change goes on under a new cookie, if any.

        Raises
        ------
        ApiError
            404: nobody of that name.
        """
        return await asyncio.to_thread(self._change_password, name, await self.passwords.hash(password), who)

    def _change_password(self, name: str, hashed: str, who: Principal) -> str | None:
        with self.store.write() as session:
            row = _found(session, name)
            row.password_hash, row.changed_utc = hashed, self.clock.utc()
            session.execute(delete(KnownPlace).where(KnownPlace.name == name))
            cookie = self.auth.end_sessions(session, row.token_hash, but=who.session_hash)
            audit.write(session, self.clock.utc(), who.name, "change password", "page", of=name)
        return cookie

    def remove(self, name: str, by: str) -> None:
        """Let nobody sign in under this name any more; the name stays taken, as the audit trail speaks of it."""
        with self.store.write() as session:
            row = _found(session, name)
            session.execute(delete(KnownPlace).where(KnownPlace.name == name))
            self.auth.end_sessions(session, row.token_hash)
        self.auth.revoke(row.token_hash[:16], by)

    def documents(self) -> list[dict[str, Any]]:
        """All users, without their hashes."""
        found = []
        for row in self.store.all(User, order=User.name):
            token = self.store.get(Token, row.token_hash)
            found.append(
                {"name": row.name, "scopes": token.scopes, "removed": token.revoked, "created_utc": row.created_utc}
            )
        return found

    def close(self) -> None:
        """Let the threads go."""
        self.passwords.close()

    def _store_password(self, name: str, hashed: str) -> None:
        with self.store.write() as session:
            row = _found(session, name)
            row.password_hash, row.changed_utc = hashed, self.clock.utc()

    def _note(self, who: str, action: str, **detail: Any) -> None:
        with self.store.write() as session:
            audit.write(session, self.clock.utc(), who, action, "page", **detail)


def _found(session: Session, name: str) -> User:
    row = session.get(User, name)
    if row is None:
        raise NotFoundError("user", name, "GET /v1/users lists them.")
    return row
