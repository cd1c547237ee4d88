"""The rigs: their names and keys. A key opens its own rig's routes, and nothing else; only its hash is kept."""

from __future__ import annotations

import re
import secrets

from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.requests import HTTPConnection

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, require_found
from stimrig.api.people.auth import unauthorized
from stimrig.api.people.pace import Guesses, place_of
from stimrig.api.store import Store, audit
from stimrig.api.store.audit import digest
from stimrig.api.store.centre_tables import CentreRig

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,59}")
KEY_BEGINS = "stimrig_rig_"
REFUSED = "The rig's key is unknown or has been revoked. Ask the centre's administrator for a new one."


class Rigs:
    """Adds, revokes and recognises rigs."""

    def __init__(self, store: Store, clock: Clock, guesses: Guesses) -> None:
        self.store, self.clock, self.guesses = store, clock, guesses

    def add(self, name: str, by: str) -> str:
        """A new rig, or a new key for one whose key was revoked; the key's text, which is shown this once.

        Raises ApiError: 422 no name for a rig; 409 the rig has a key.
        """
        if not NAME.fullmatch(name) or name != name.strip():
            detail = (
                "A rig's name has letters, digits, spaces and . _ -, at most 60, and begins with a letter or digit."
            )
            raise ApiError(422, "invalid-input", "This is no name for a rig", detail)
        key, now = KEY_BEGINS + secrets.token_urlsafe(32), self.clock.utc()
        with self.store.write() as session:
            row = session.scalars(select(CentreRig).where(CentreRig.name == name)).first()
            if row is not None and row.revoked_utc is None:
                detail = (
                    f"The rig {name} has a key. Revoke that one first, then add the rig again: it keeps its records."
                )
                raise ApiError(409, "exists", "The rig has a key", detail)
            if row is None:
                row = CentreRig(name=name, created_utc=now, created_by=by, recordings=0)
                session.add(row)
            row.key_hash, row.key_prefix, row.revoked_utc = digest(key), key[:18], None
            audit.write(session, now, by, "add rig", name)
        return key

    def revoke(self, name: str, by: str) -> None:
        """The rig's key opens nothing any more; what it pushed stays. Raises NotFoundError."""
        with self.store.write() as session:
            row = session.scalars(select(CentreRig).where(CentreRig.name == name)).first()
            row = require_found(row, "rig", name[:80], "GET /v1/rigs lists them.")
            if row.revoked_utc is None:
                row.revoked_utc = now = self.clock.utc()
                audit.write(session, now, by, "revoke rig", name)

    def all(self) -> list[CentreRig]:
        return self.store.all(CentreRig, order=CentreRig.name)

    def named(self, name: str) -> CentreRig | None:
        return self.store.first(CentreRig, CentreRig.name == name)

    def identify(self, connection: HTTPConnection) -> CentreRig:
        """The rig whose key a request carries; looked up each time, so that a revoked one ends at once everywhere.

        Raises ApiError: 401 no key, unknown, or revoked; 429 too many that were none.
        """
        kind, _, text = connection.headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer" or not text.strip():
            raise unauthorized("Send the rig's key: `Authorization: Bearer KEY`.")
        found: CentreRig | None = self.store.first(CentreRig, CentreRig.key_hash == digest(text.strip()))
        if found is None:
            self.guesses.unknown_token(place_of(connection.client.host if connection.client else ""))
            raise unauthorized(REFUSED)
        if found.revoked_utc is not None:
            raise unauthorized(REFUSED)
        return found


def still(session: Session, rig: CentreRig, hold: bool = True) -> CentreRig:
    """The rig's row, held to the transaction's end, if the key that opened it still does. Raises ApiError (401)."""
    row = session.get(CentreRig, rig.id, with_for_update=hold, populate_existing=True)
    if row is None or row.revoked_utc is not None or row.key_hash != rig.key_hash:
        raise unauthorized(REFUSED)
    return row
