"""Answers about people, tokens and the audit trail."""

from __future__ import annotations

from pydantic import Field, JsonValue

from stimrig.api.people.auth import Scope
from stimrig.api.web.responses.base import Document


class UserOut(Document):
    """A person who may sign in on the page."""

    name: str
    scopes: list[Scope]
    created_utc: str


class ListedUser(UserOut):
    """A person in the list of all."""

    removed: bool = Field(description="signs in no more")


class SessionOut(Document):
    """A session; its cookie is in `Set-Cookie`."""

    name: str
    scopes: list[Scope]
    csrf: str = Field(description="send it as `X-CSRF-Token` with everything but GET")


class KeyOut(Document):
    """A controller's key."""

    key: str = Field(description="its text, shown this once; send it as `Authorization: Bearer …`")
    prefix: str
    scopes: list[Scope]
    expires_utc: str


class TokenOut(Document):
    """A token that was issued."""

    token: str = Field(description="its text, shown this once; send it as `Authorization: Bearer …`")
    name: str
    scopes: list[Scope]
    expires_utc: str | None = Field(description="null: it does not expire")


class ListedToken(Document):
    """A token, without its text."""

    id: str = Field(description="for `DELETE /v1/tokens/{id}`")
    prefix: str
    name: str
    scopes: list[Scope]
    created_utc: str
    expires_utc: str | None
    revoked: bool
    origin: str
    participant: str | None = Field(None, description="the only one that a controller's key opens")
    plan: dict[str, JsonValue] | None = Field(None, description="what trials that key may play")


class AuditEntryOut(Document):
    """Who did what."""

    seq: int
    at_utc: str
    who: str
    action: str
    subject: str
    detail: dict[str, JsonValue] = Field(description="what belongs to this action: reasons, limits, ids")
    previous_hash: str
    hash: str = Field(description="SHA-256 of the entry's canonical JSON without this field")


class AuditOut(Document):
    """The audit trail."""

    whole: bool = Field(description="whether the chain of hashes holds")
    first_broken: int | None = Field(description="`seq` of the first entry that does not hold, or was changed")
    missing_since: int | None = Field(description="`seq` of the first entry that a receipt names and that is gone")
    entries: list[AuditEntryOut]
