"""People with passwords: signing in, the password once more before a model is approved, new passwords."""

from __future__ import annotations

import asyncio
import hmac
import secrets
import unicodedata
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError
from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, require_found
from stimrig.api.people.auth import Auth, Principal, Scope, unauthorized
from stimrig.api.people.pace import Guesses, place_of
from stimrig.api.store import Store, locking
from stimrig.api.store.audit import digest
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Confirmation, KnownPlace, Token, User

CONFIRMED_S = 120.0
"""How long a password given once more is good for one approval."""
MOST_PLACES = 20
"""Number of places remembered for a user."""


class People:
    """Users of the page."""

    def __init__(self, store: Store, clock: Clock, auth: Auth, guesses: Guesses) -> None:
        self.store, self.clock, self.auth, self.guesses = store, clock, auth, guesses
        self.passwords = Passwords()

    async def add(self, name: str, password: str, scopes: list[Scope], by: str) -> User:
        """Add a user. Raises ApiError: 409 the name is taken."""
        return await asyncio.to_thread(self._add, name, await self.passwords.hash(password), scopes, by)

    def _add(self, name: str, hashed: str, scopes: list[Scope], by: str) -> User:
        with self.store.write() as session:
            existing = user_named(session, name)
            if existing is not None:
                raise ApiError(409, "exists", "The name is taken", f"User {existing.name!r} exists. Take another name.")
            token = self.auth.token_of_person(session, name, scopes)
            row = User(name=name, folded_name=folded_name(name), password_hash=hashed, token_hash=token.hash)
            row.created_utc = row.changed_utc = now = self.clock.utc()
            locking.write(session, row, now, by, "add user", name, scopes=token.scopes)
            session.add(row)
        return row

    async def sign_in(self, name: str, password: str, address: str) -> str:
        """Open a session; its cookie.

        Raises ApiError: 401 wrong name or password (not said which); 429 too many tries.
        """
        place = place_of(address)
        row, known = await asyncio.to_thread(self._look_up, name, place)
        name = row.name if row else folded_name(name)
        with self.passwords.room(known) as lane:
            self.guesses.password(name, place, known)
            right = await self.passwords.verify(lane, row.password_hash if row else None, password)
        if not right or row is None:
            await asyncio.to_thread(self.store.note, self.clock, name[:80], "sign in refused", "page", address=address)
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
            row = user_named(session, name)
            return row, row is not None and session.get(KnownPlace, (row.name, place)) is not None

    def _remember(self, name: str, place: str) -> None:
        with self.store.write() as session:
            session.merge(KnownPlace(name=name, place=place, at_unix_s=self.clock.unix_s()))
            session.flush()
            newest = select(KnownPlace).where(KnownPlace.name == name).order_by(KnownPlace.at_unix_s.desc())
            for old in session.scalars(newest.offset(MOST_PLACES)).all():
                session.delete(old)

    def any(self) -> bool:
        """Return whether any user exists."""
        return bool(self.store.all(User, limit=1))

    async def confirm(self, principal: Principal, password: str) -> None:
        """Confirm with the password, which allows one approval within two minutes.

        Raises ApiError: 401 wrong password; 409 signed in with a token; 429 too many tries.
        """
        session_hash = principal.session_hash
        if session_hash is None:
            raise ApiError(409, "no-password", "There is no password to confirm", "Signed in with a token.")
        if not await self._right(session_hash, principal.name, password):
            await asyncio.to_thread(self.store.note, self.clock, principal.name, "confirmation refused", "page")
            detail = "Nothing was decided. Go back and enter it again."
            raise unauthorized(detail, "wrong-password", "The password does not match")
        await asyncio.to_thread(self._confirm, session_hash)

    async def _right(self, session_hash: str, name: str, secret: str, token_hash: str | None = None) -> bool:
        """Check a user's password, or the token of this hash, given again in a session."""
        row: User | None = None if token_hash else await asyncio.to_thread(self.store.get, User, name)
        with self.passwords.room(known=True) as lane:
            self.guesses.confirmation(session_hash)
            if token_hash:
                right = hmac.compare_digest(digest(secret), token_hash)
            else:
                right = await self.passwords.verify(lane, row.password_hash if row else None, secret)
        if right:
            self.guesses.confirmation_was_right(session_hash)
        return right

    async def unlock(self, principal: Principal, secret: str) -> None:
        """Unlock a session by its user's password, or by the token that opened it.

        Raises ApiError: 401 it is not the right one; 429 too many tries.
        """
        page_session = principal.page_session
        if page_session is None or not principal.locked:
            return
        by_token = principal.session_hash is None
        if not await self._right(
            page_session.hash, principal.name, secret, page_session.token_hash if by_token else None
        ):
            await asyncio.to_thread(self.store.note, self.clock, principal.name, "unlock refused", "page")
            title = "The token does not match" if by_token else "The password does not match"
            raise unauthorized("The page stays locked. Enter it again.", "wrong-password", title)
        await asyncio.to_thread(self.auth.idle.unlock, page_session.hash, principal.name)

    def _confirm(self, session_hash: str) -> None:
        with self.store.write() as session:
            session.merge(Confirmation(session_hash=session_hash, at_unix_s=self.clock.unix_s()))

    async def refuse_unconfirmed(self, principal: Principal) -> None:
        """Refuse an approval by a user who has not confirmed with the password.

        Raises ApiError: 403 the password is asked for.
        """
        if principal.session_hash is None:
            return
        if not await asyncio.to_thread(self._use_confirmation, principal.session_hash):
            detail = (
                f"To approve, enter your password again: POST /v1/sessions/confirm, at most {CONFIRMED_S:.0f} s before."
            )
            raise ApiError(403, "confirm-password", "Please confirm with your password", detail)

    async def is_confirmed(self, session_hash: str | None) -> bool:
        """Return whether an approval needs no password: a token has none, or it was given and not used yet."""
        if session_hash is None:
            return True
        row: Confirmation | None = await asyncio.to_thread(self.store.get, Confirmation, session_hash)
        return row is not None and self._is_valid(row)

    def _is_valid(self, row: Confirmation) -> bool:
        return 0 <= self.clock.unix_s() - row.at_unix_s <= CONFIRMED_S

    def _use_confirmation(self, session_hash: str) -> bool:
        with self.store.write() as session:
            row = session.get(Confirmation, session_hash)
            if row is None:
                return False
            session.delete(row)
            return self._is_valid(row)

    async def change_password(self, name: str, password: str, principal: Principal, tags: Tags | None) -> str | None:
        """Change a password and end the user's sessions; return the new cookie of the session that made the change.

        Raises ApiError: 404 nobody of that name; 412 the account was changed since it was shown.
        """
        return await asyncio.to_thread(
            self._change_password, name, await self.passwords.hash(password), principal, tags
        )

    def _change_password(self, name: str, hashed: str, principal: Principal, tags: Tags | None) -> str | None:
        with self.store.write() as session:
            row = known_user(session, name)
            locking.check(session, row, tags)
            row.password_hash, row.changed_utc = hashed, self.clock.utc()
            session.execute(delete(KnownPlace).where(KnownPlace.name == row.name))
            cookie = self.auth.end_sessions(session, row.token_hash, but=principal.session_hash)
            locking.write(session, row, self.clock.utc(), principal.name, "change password", row.name)
        return cookie

    def remove(self, name: str, by: str) -> None:
        """Let nobody sign in under this name any more; the name stays taken, as the audit trail speaks of it."""
        with self.store.write() as session:
            row = known_user(session, name)
            session.execute(delete(KnownPlace).where(KnownPlace.name == row.name))
            self.auth.end_sessions(session, row.token_hash)
            self.auth.revoke_within(session, row.token_hash[:16], by)
            locking.write(session, row, self.clock.utc(), by, "remove user", row.name)

    def documents(self) -> list[dict[str, Any]]:
        """List all users, without their hashes."""
        documents = []
        for row in self.store.all(User, order=User.name):
            token = self.store.get(Token, row.token_hash)
            account = {"name": row.name, "created_utc": row.created_utc, "version": row.version}
            documents.append({**account, "scopes": token.scopes, "removed": token.revoked})
        return documents

    def close(self) -> None:
        """Shut the threads down."""
        self.passwords.close()

    def _store_password(self, name: str, hashed: str) -> None:
        with self.store.write() as session:
            row = known_user(session, name)
            row.password_hash, row.changed_utc = hashed, self.clock.utc()


def user_named(session: Session, name: str) -> User | None:
    """The person of a name as it was typed; the exact one first, as names from before were told apart by case."""
    if "\0" in name:  # PostgreSQL takes no such text, and nobody is called so
        return None
    same = select(User).where(User.folded_name == folded_name(name)).order_by(User.name).limit(1)
    return session.get(User, name) or session.scalars(same).first()


def known_user(session: Session, name: str) -> User:
    return require_found(user_named(session, name), "user", name, "GET /v1/users lists them.")


MOST_STRANGERS, MOST_KNOWN = 8, 64
"""Checks that may wait; each takes about 0.1 s and 64 MB."""


class Lane:
    """A queue of password checks: one thread and a bounded number of waiting checks."""

    def __init__(self, name: str, capacity: int) -> None:
        self.threads, self.capacity, self.inside = ThreadPoolExecutor(1, name), capacity, 0


class Passwords:
    """argon2id: known people at known places in one lane, strangers in another, which may be full.

    In threads of its own: what guesses cost fills no thread that anything else needs.
    """

    def __init__(self) -> None:
        self.hasher = PasswordHasher()  # argon2id, RFC 9106's parameters for little memory
        self.nobody = self.hasher.hash(secrets.token_hex(16))
        """Hash of a random password, checked for unknown names."""
        self._strangers, self._known = Lane("passwords", MOST_STRANGERS), Lane("known-passwords", MOST_KNOWN)

    @contextmanager
    def room(self, known: bool) -> Iterator[Lane]:
        """A place in the lane. Raises ApiError: 429 too many wait already."""
        lane = self._known if known else self._strangers
        if lane.inside >= lane.capacity:
            problem = ApiError(429, "too-many-tries", "Too many people sign in at once", "Try again in 2 s.")
            problem.headers["Retry-After"] = "2"
            raise problem
        lane.inside += 1
        try:
            yield lane
        finally:
            lane.inside -= 1

    async def verify(self, lane: Lane, hashed: str | None, password: str) -> bool:
        """Check a password; takes as long for an unknown name."""

        def check() -> bool:
            try:
                return self.hasher.verify(hashed or self.nobody, password) and hashed is not None
            except (Argon2Error, InvalidHashError):
                return False

        return await asyncio.get_running_loop().run_in_executor(lane.threads, check)

    async def hash(self, password: str) -> str:
        """Hash a password for storage."""
        with self.room(known=True) as lane:
            return await asyncio.get_running_loop().run_in_executor(lane.threads, self.hasher.hash, password)

    def close(self) -> None:
        """Shut the threads down."""
        for lane in (self._strangers, self._known):
            lane.threads.shutdown(wait=False, cancel_futures=True)


# Names: with spaces and umlauts, one way to write each, and no two that look the same.
LONGEST = 80
NAME_MARKS = " ._@'’,()-"
"""Characters allowed in a name besides letters, their marks and digits."""
UNSEEN = frozenset("\u034f\u115f\u1160\u17b4\u17b5\u3164\uffa0")
"""Letters and marks that nobody sees; Unicode calls them ignorable."""
ALPHABETS = frozenset({"LATIN", "CYRILLIC", "GREEK", "ARMENIAN", "CHEROKEE"})
"""Alphabets that share letters of one shape: a name keeps to one of them."""


def written_name(text: str) -> str:
    """A name in the one way that it is stored: composed (NFC), every run of white space one space, none at the ends.

    Raises ValueError: in a sentence for people: what the name holds that it cannot, or how long it is.
    """
    composed = unicodedata.normalize("NFC", text).strip()
    spaced = "".join(" " if unicodedata.category(sign) == "Zs" else sign for sign in composed)
    name = " ".join(part for part in spaced.split(" ") if part)
    if not 1 <= len(name) <= LONGEST:
        raise ValueError(f"a name has 1 to {LONGEST} characters, this one {len(name)}")
    odd = next((sign for sign in name if not _allowed_in_name(sign)), None)
    if odd is not None:
        raise ValueError(f"the character {_called_sign(odd)} cannot stand in a name")
    if not any(unicodedata.category(sign)[0] in "LN" for sign in name):
        raise ValueError("a name has at least one letter or digit")
    alphabets = {unicodedata.name(sign, "").split(" ")[0] for sign in name} & ALPHABETS
    if len(alphabets) > 1:
        raise ValueError(
            f"letters of two alphabets ({', '.join(sorted(alphabets)).lower()}) look alike; take one of them"
        )
    return name


def folded_name(text: str) -> str:
    """A name as two people must not share it: without its case and without the ways to write its letters."""
    plain = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", text).casefold())
    return " ".join(plain.split())


def _allowed_in_name(sign: str) -> bool:
    kind = unicodedata.category(sign)
    letter = kind[0] == "L" or kind in ("Mn", "Mc", "Nd")
    selector = "VARIATION SELECTOR" in unicodedata.name(sign, "")
    return (letter and sign not in UNSEEN and not selector) or sign in NAME_MARKS


def _called_sign(sign: str) -> str:
    """A character so that a person can find it, also where it is not seen."""
    return f"U+{ord(sign):04X} ({unicodedata.name(sign, 'without a name').lower()})"
