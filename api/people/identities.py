"""Which account a provider's person has: by issuer and subject alone, never by a name or an address.

An administrator links a subject to an account, or a group of the provider's makes one. A link counts for nothing where
the account was removed here.
"""

from __future__ import annotations

from sqlalchemy import delete
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.people.accounts import LONGEST, People, folded_name, known_user, user_named, written_name
from stimrig.api.people.auth import ROLES
from stimrig.api.people.provider import SignedIn
from stimrig.api.store import audit, seen
from stimrig.api.store.tables import Identity, Token, User

LINK, ROLE = "link sign-in", "change role"


class Identities:
    """The accounts of those whom a provider signs in.

    `roles`: by the provider's groups; the first one that a person has counts. Raises SettingsError: no such role.
    """

    def __init__(self, people: People, clock: Clock, issuer: str, roles: dict[str, str]) -> None:
        self.people, self.clock, self.issuer, self.roles = people, clock, issuer, roles
        if odd := next((role for role in roles.values() if role not in ROLES), None):
            raise SettingsError(f"OIDC_ROLES: {odd} is no role; there are {', '.join(ROLES)}")

    def account(self, who: SignedIn) -> tuple[str, str]:
        """Name and token's hash of the account; a group may make it, or change what it may do.

        Raises ApiError: 403 nobody has given this person a role; 401 the account was removed.
        """
        role = next((role for group, role in self.roles.items() if group in who.groups), None)
        with self.people.store.write() as session:
            found = session.get(Identity, (who.issuer, who.subject)) or self._new(session, who, role)
            user = session.get(User, found.name) if found else None
            token = session.get(Token, user.token_hash) if user else None
            if found is not None and token is not None and found.by_group and not token.revoked:
                self._follow(session, found.name, token, role)
            taken_away = found is not None and found.by_group and role is None
        if user is None or token is None or (taken_away and not token.revoked):
            raise no_role(who.subject)
        if token.revoked:
            raise ApiError(401, "removed", "Not signed in", "This user has been removed. Ask an administrator.")
        return user.name, token.hash

    def _new(self, session: Session, who: SignedIn, role: str | None) -> Identity | None:
        """An account that a group makes. Nobody knows its password: an administrator may set one."""
        if role is None:
            return None
        user = self.people.put(session, self._free(session, who), ROLES[role], self.people.passwords.nobody, "provider")
        return self._put(session, who.subject, user.name, "provider", by_group=True)

    def _free(self, session: Session, who: SignedIn) -> str:
        """The person's name as far as it may be one here; one that is taken is somebody else's."""
        try:
            name = written_name(who.name)
        except ValueError:
            name = f"person {folded_name(audit.digest(who.subject))[:8]}"
        free, number = name, 1
        while user_named(session, free) is not None:
            number += 1
            free = f"{name[: LONGEST - 8].rstrip()} ({number})"
        return free

    def _follow(self, session: Session, name: str, token: Token, role: str | None) -> None:
        """What a group gave, it takes: its person's open sessions, too."""
        scopes = [str(scope) for scope in ROLES[role]] if role else []
        if sorted(token.scopes) != sorted(scopes):
            taken = {"token": token.hash[:16]} if set(token.scopes) - set(scopes) else {}  # as of one that is revoked
            token.scopes = scopes
            self.people.auth.end_sessions(session, token.hash)
            audit.write(session, self.clock.utc(), "provider", ROLE, name, scopes=scopes, **taken)

    def link(self, name: str, subject: str, by: str) -> None:
        """From now on this subject is this person, and nobody else. Raises ApiError: 404; 409 changed since."""
        with self.people.store.write() as session:
            user = known_user(session, name)
            seen.check(session, seen.account(user.name))
            session.execute(delete(Identity).where(Identity.issuer == self.issuer, Identity.name == user.name))
            session.execute(delete(Identity).where(Identity.issuer == self.issuer, Identity.subject == subject))
            self._put(session, subject, user.name, by, by_group=False)
            self.people.auth.end_sessions(session, user.token_hash)

    def unlink(self, name: str, by: str) -> None:
        """The provider signs this person in no more, and the sessions end. Raises ApiError: 404."""
        with self.people.store.write() as session:
            user = known_user(session, name)
            seen.check(session, seen.account(user.name))
            session.execute(delete(Identity).where(Identity.issuer == self.issuer, Identity.name == user.name))
            self.people.auth.end_sessions(session, user.token_hash)
            audit.write(session, self.clock.utc(), by, LINK, user.name, known_as=None)

    def _put(self, session: Session, subject: str, name: str, by: str, by_group: bool) -> Identity:
        row = Identity(issuer=self.issuer, subject=subject, name=name, by_group=by_group, linked_by=by)
        row.linked_utc = self.clock.utc()
        session.add(row)
        session.flush()
        audit.write(session, row.linked_utc, by, LINK, name, known_as=audit.digest(subject)[:16])
        return row


def no_role(subject: str) -> ApiError:
    """403: the provider knows the person, and here nobody has given them a role."""
    detail = "The provider knows you; here nobody has given you a role yet. Tell an administrator this subject:"
    return ApiError(403, "no-role", "You have no role here", detail, subject=subject)
