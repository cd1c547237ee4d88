"""Items of a rig's chain: read strictly, and their hashes (decision 0013)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from stimrig.api.errors import ApiError
from stimrig.api.outbox.chain import BEGIN, item_hash
from stimrig.api.store.hashes import canonical, digest
from stimrig.identify.strict_json import BadJson, parse

MOST_ITEMS = 500
MOST_ITEM_BYTES = 4_000_000
DEEPEST = 40
"""Brackets within one another, of a batch: an item's body is in its third."""
LARGEST = 2**53

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
ChainId = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
Count = Annotated[int, Field(ge=0, le=LARGEST)]


class _In(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class ItemIn(_In):
    """An item as a rig sends it."""

    seq: Annotated[int, Field(ge=1, le=LARGEST)]
    kind: Annotated[str, StringConstraints(pattern=r"^[a-z-]{1,20}$")]
    key: Annotated[str, StringConstraints(min_length=1, max_length=200)]
    body: dict[str, Any]
    sha256: Sha256
    file: Sha256 | None = None
    file_bytes: Count | None = None
    at_utc: Annotated[str, StringConstraints(max_length=40)]
    previous: Sha256
    hash: Sha256


class BatchIn(_In):
    """What `POST /v1/rig/items` takes."""

    chain: ChainId
    items: Annotated[list[ItemIn], Field(max_length=MOST_ITEMS)]


class HelloIn(_In):
    """What `POST /v1/rig/hello` takes."""

    chain: ChainId
    seq: Count
    hash: Sha256
    version: Annotated[str, StringConstraints(max_length=200)] | None = None
    utc: Annotated[str, StringConstraints(max_length=40)]
    disk_free_bytes: Count | None = None
    disk_total_bytes: Count | None = None
    state: Annotated[str, StringConstraints(max_length=100)] | None = None
    reason: Annotated[str, StringConstraints(max_length=2000)] | None = None
    damaged: Annotated[list[Annotated[str, StringConstraints(max_length=200)]], Field(max_length=1000)] = []
    waiting_items: Count | None = None
    waiting_files: Count | None = None


@dataclass(frozen=True)
class Item:
    """An item whose hashes hold; `text` is its body's canonical text."""

    sent: ItemIn
    text: str


def read(model: type[BaseModel], raw: bytes) -> Any:
    """A body of a rig, strictly.

    Raises
    ------
    ApiError
        400: no sound JSON; 422: a field does not hold.
    """
    try:
        return model.model_validate(parse(raw, deepest=DEEPEST))
    except BadJson as error:
        raise ApiError(400, "bad-request", "The body cannot be read", f"{error}. Send JSON (RFC 8259).") from error
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "body"
        detail = f"{place[:120]}: {first['msg']}"
        raise ApiError(422, "invalid-input", "The request is not valid", detail) from error


def checked(sent: ItemIn) -> Item:
    """The item, its hashes compared.

    Raises
    ------
    ApiError
        422 `hash-differs`.
    """
    try:
        text = canonical(sent.body)
        held = digest(text) == sent.sha256 and item_hash(sent.model_dump(exclude={"body"})) == sent.hash
    except (ValueError, RecursionError) as error:
        detail = f"Item {sent.seq} cannot be written as canonical JSON. Nothing of the batch was taken."
        raise ApiError(422, "hash-differs", "An item differs from its hash", detail) from error
    if not held:
        detail = f"Item {sent.seq} ({sent.kind}) differs from its hash. Nothing of the batch was taken."
        raise ApiError(422, "hash-differs", "An item differs from its hash", detail)
    if (sent.seq == 1) != (sent.kind == BEGIN) or (sent.file is None) != (sent.file_bytes is None):
        detail = f"Item {sent.seq}: only the first item is `begin`, and a file has its length."
        raise ApiError(422, "invalid-input", "The request is not valid", detail)
    return Item(sent, text)
