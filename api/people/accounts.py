"""People with passwords: signing in, the password once more before a model is approved, new passwords.

What checks a password takes 0.1 s and is called in a thread.
"""

from __future__ import annotations

import re
import secrets
import threading
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError
from sqlalchemy import select
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, require_found
from stimrig.api.people.auth import Auth, Principal, Scope, unauthorized
from stimrig.api.people.pace import Guesses, password_keys, place_of, refuse
from stimrig.api.store import Store, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import PageSession, Token, User

CONFIRMED_S = 120.0
"""Time for which a re-entered password is valid for one approval, s."""
MOST_PLACES = 20
"""Number of places remembered for a user."""


class People:
    """Users of the page."""

    def __init__(self, store: Store, clock: Clock, auth: Auth, guesses: Guesses) -> None:
        self.store, self.clock, self.auth, self.guesses = store, clock, auth, guesses
        self.passwords = Passwords()

    def any(self) -> bool:
        """Return whether any user exists."""
        return bool(self.store.all(User, limit=1))

    def documents(self) -> list[dict[str, Any]]:
        """List all users, without their hashes."""
        documents = []
        for row in self.store.all(User, order=User.name):
            token = self.store.get(Token, row.token_hash)
            account = {"name": row.name, "created_utc": row.created_utc, "version": row.version}
            documents.append({**account, "scopes": token.scopes, "removed": token.revoked})
        return documents

    def add(self, name: str, password: str, scopes: list[Scope], by: str) -> User:
        """Add a user. Raises ApiError: 409 the name is taken."""
        hashed, now = self.passwords.hash(password), self.clock.utc()
        with self.store.write() as session:
            if (existing := user_named(session, name)) is not None:
                raise ApiError(409, "exists", "The name is taken", f"User {existing.name!r} exists. Take another name.")
            token = self.auth.token_of_person(session, name, scopes)
            row = User(name=name, folded_name=folded_name(name), password_hash=hashed, token_hash=token.hash)
            row.created_utc = now
            locking.write(session, row, now, by, "add user", name, scopes=token.scopes)
            session.add(row)
        return row

    def sign_in(self, name: str, password: str, address: str) -> str:
        """Open a session; its cookie.

        Raises ApiError: 401 wrong name or password (not said which); 429 too many tries.
        """
        place = place_of(address)
        with self.store.read() as session:
            row = user_named(session, name)
        known = row is not None and place in row.places
        name = row.name if row else folded_name(name)
        keys = password_keys(name, place, known)
        with self.passwords.room(known):
            self.guesses.admit(*keys)
            right = self.passwords.verify(row.password_hash if row else None, password, known)
        if not right or row is None:
            self.store.note(self.clock, name[:80], "sign in refused", "page", address=address)
            raise unauthorized("Name and password do not match.")
        token: Token = self.store.get(Token, row.token_hash)
        if token.revoked:
            raise unauthorized("This user has been removed. Ask an administrator.")
        self.guesses.was_right(*keys)
        hashed = row.password_hash
        if self.passwords.hasher.check_needs_rehash(hashed):
            hashed = self.passwords.hash(password)
        with self.store.write() as session:
            if (row := session.get(User, name)) is not None:
                row.password_hash = hashed
                row.places = [place, *(other for other in row.places if other != place)][:MOST_PLACES]
        return self.auth.open_session(token.hash, name)

    def confirm(self, principal: Principal, password: str) -> None:
        """Confirm with the password, which allows one approval within two minutes.

        Raises ApiError: 401 wrong password; 409 signed in with a token; 429 too many tries.
        """
        if not principal.has_password or principal.page_session is None:
            raise ApiError(409, "no-password", "There is no password to confirm", "Signed in with a token.")
        key = ("session", principal.page_session.hash)
        with self.passwords.room(known=True):
            self.guesses.admit(key)
            user: User | None = self.store.get(User, principal.name)
            right = self.passwords.verify(user.password_hash if user else None, password, known=True)
        if not right:
            self.store.note(self.clock, principal.name, "confirmation refused", "page")
            detail = "Nothing was decided. Enter it again."
            raise unauthorized(detail, "wrong-password", "The password does not match")
        self.guesses.was_right(key)
        with self.store.write() as session:
            if (row := session.get(PageSession, principal.page_session.hash)) is not None:
                row.confirmed_unix_s = self.clock.unix_s()

    def is_confirmed(self, principal: Principal) -> bool:
        """Return whether an approval needs no password: a token has none, or it was given and not used yet."""
        return not principal.has_password or self._is_valid(principal.page_session)

    def refuse_unconfirmed(self, principal: Principal) -> None:
        """Use up the confirmation of an approval by a user with a password.

        Raises ApiError: 403 the password is asked for.
        """
        if not principal.has_password or principal.page_session is None:
            return
        with self.store.write() as session:
            row = session.get(PageSession, principal.page_session.hash)
            confirmed = self._is_valid(row)
            if row is not None:
                row.confirmed_unix_s = None
        if not confirmed:
            detail = (
                f"To approve, enter your password again: POST /v1/sessions/confirm, at most {CONFIRMED_S:.0f} s before."
            )
            raise ApiError(403, "confirm-password", "Please confirm with your password", detail)

    def _is_valid(self, row: PageSession | None) -> bool:
        if row is None or row.confirmed_unix_s is None:
            return False
        return 0 <= self.clock.unix_s() - row.confirmed_unix_s <= CONFIRMED_S

    def change_password(self, name: str, password: str, principal: Principal, tags: Tags) -> str | None:
        """Change a password and end the user's sessions; return the new cookie of the session that made the change.

        Raises ApiError: 404 nobody of that name; 412 the account was changed since it was shown.
        """
        hashed = self.passwords.hash(password)
        with self.store.write() as session:
            row = known_user(session, name)
            locking.check(session, row, tags)
            row.password_hash, row.places = hashed, []
            session_hash = principal.page_session.hash if principal.page_session else None
            cookie = self.auth.end_sessions(session, row.token_hash, but=session_hash)
            locking.write(session, row, self.clock.utc(), principal.name, "change password", row.name)
        return cookie

    def remove(self, name: str, by: str) -> None:
        """Let nobody sign in under this name any more; the name stays taken, as the audit trail speaks of it."""
        with self.store.write() as session:
            row = known_user(session, name)
            row.places = []
            self.auth.end_sessions(session, row.token_hash)
            self.auth.revoke_within(session, row.token_hash[:16], by)
            locking.write(session, row, self.clock.utc(), by, "remove user", row.name)


def user_named(session: Session, name: str) -> User | None:
    """Return the person of a name as it was typed."""
    if "\0" in name:  # PostgreSQL takes no such text, and nobody is called so
        return None
    return session.scalars(select(User).where(User.folded_name == folded_name(name))).first()


def known_user(session: Session, name: str) -> User:
    """Return a user. Raises NotFoundError."""
    return require_found(user_named(session, name), "user", name, "GET /v1/users lists them.")


MOST_STRANGERS, MOST_KNOWN = 8, 16
"""Threads that may wait for a check at the same time: others find threads to work in."""


class Passwords:
    """argon2id, one check at a time of known people at known places, and one of strangers, who may be refused."""

    def __init__(self) -> None:
        self.hasher = PasswordHasher()  # argon2id, RFC 9106's parameters for little memory
        self.nobody = self.hasher.hash(secrets.token_hex(16))
        """Hash of a random password, checked for unknown names."""
        self._rooms = {
            False: threading.BoundedSemaphore(MOST_STRANGERS), True: threading.BoundedSemaphore(MOST_KNOWN)
        }  # fmt: skip
        self._turns = {False: threading.Lock(), True: threading.Lock()}

    @contextmanager
    def room(self, known: bool) -> Iterator[None]:
        """Hold a place among those who wait. Raises ApiError: 429 there is none."""
        room = self._rooms[known]
        if not room.acquire(blocking=False):
            refuse(1.0, "Too many people sign in at once")
        try:
            yield
        finally:
            room.release()

    def verify(self, hashed: str | None, password: str, known: bool) -> bool:
        """Check a password; takes as long for an unknown name."""
        with self._turns[known]:
            try:
                return self.hasher.verify(hashed or self.nobody, password) and hashed is not None
            except (Argon2Error, InvalidHashError):
                return False

    def hash(self, password: str) -> str:
        """Hash a password for storage."""
        with self.room(known=True), self._turns[True]:
            return self.hasher.hash(password)


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
    name = re.sub(" +", " ", "".join(" " if unicodedata.category(sign) == "Zs" else sign for sign in composed))
    if not 1 <= len(name) <= LONGEST:
        raise ValueError(f"a name has 1 to {LONGEST} characters, this one {len(name)}")
    for sign in name:
        kind, called = unicodedata.category(sign), unicodedata.name(sign, "without a name")
        is_visible = sign not in UNSEEN and "VARIATION SELECTOR" not in called
        if not (is_visible and (kind[0] == "L" or kind in ("Mn", "Mc", "Nd"))) and sign not in NAME_MARKS:
            raise ValueError(f"the character U+{ord(sign):04X} ({called.lower()}) cannot stand in a name")
    if not any(unicodedata.category(sign)[0] in "LN" for sign in name):
        raise ValueError("a name has at least one letter or digit")
    alphabets = {unicodedata.name(sign, "").split(" ")[0] for sign in name} & ALPHABETS
    if len(alphabets) > 1:
        both = ", ".join(sorted(alphabets)).lower()
        raise ValueError(f"letters of two alphabets ({both}) look alike; take one of them")
    return name


def folded_name(text: str) -> str:
    """A name as two people must not share it: without its case and without the ways to write its letters."""
    plain = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", text).casefold())
    return " ".join(plain.split())
