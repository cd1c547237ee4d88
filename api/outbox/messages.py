"""What a rig and its centre say to one another (decision 0013): a model each, read with suspicion on both sides."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, WithJsonSchema

from stimrig.api.outbox.chain import Position
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.store.audit import GENESIS

MOST_ITEMS = 500
LARGEST = 2**53
WRONG = {
    **dict.fromkeys(("seq", "bytes", "have_bytes"), "is no whole number from 0 on"),
    **dict.fromkeys(("hash", "sha256"), "is no SHA-256"),
    "whole": "is neither true nor false",
    "heads": "are no receipts",
}
"""What is said of a member of an answer that does not hold."""

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
ChainId = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
Count = Annotated[int, Field(ge=0, le=LARGEST)]


Number = Annotated[int, Field(ge=0, lt=LARGEST), WithJsonSchema({"type": "integer"})]
Digest = Annotated[Sha256, WithJsonSchema({"type": "string"})]
"""As `Count` and `Sha256`, but not said in the centre's OpenAPI document."""


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


class _Out(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")


class PlaceOut(_Out):
    """Where a chain stands."""

    seq: Number = Field(description="newest item that the centre has; 0: none")
    hash: Digest = Field(description="its hash; 64 zeros: none")

    def position(self) -> Position:
        """The place. Raises WrongAnswerError where number and hash are of two places."""
        if (self.seq == 0) != (self.hash == GENESIS):
            raise WrongAnswerError("the answer's `seq` and `hash` do not belong together")
        return Position(self.seq, self.hash)


class HelloOut(PlaceOut):
    """The answer to a greeting."""

    utc: str


class LackingOut(_Out):
    """A file that the centre lacks."""

    sha256: Digest
    bytes: Number
    have_bytes: Number = Field(description="go on from there")


class LackingFilesOut(_Out):
    """Files that the centre lacks, oldest first."""

    files: list[LackingOut]


class HeadsOut(_Out):
    """Heads of the rig's audit trail, as the centre countersigned them, in the order in which they were told."""

    heads: list[Receipt]


class PieceOut(_Out):
    """A piece was taken."""

    have_bytes: Number
    whole: bool


class PushError(Exception):
    """Something was not told: one line for people. `state`: what it is called in the status (`api.outbox.status`)."""

    state = "refused"

    def __init_subclass__(cls, state: str = "refused") -> None:
        cls.state = state


class UnreachableError(PushError, state="unreachable"):
    """No answer came."""


class KeyRefusedError(PushError, state="key-refused"):
    """The centre does not know the rig's key, or not any more."""


class WrongAnswerError(PushError, state="wrong-answer"):
    """What answered does not speak as a centre does."""


class BucketError(PushError, state="bucket-failed"):
    """The centre cannot keep files at the moment: its bucket is full or gone."""


class RefusedError(PushError):
    """The centre refused what was sent. `code`: id of the problem, as `out-of-order`; `said`: the problem's members."""

    def __init__(self, words: str, code: str, said: dict[str, object]) -> None:
        super().__init__(words)
        self.code, self.said = code, said

    def number(self, name: str) -> int:
        """A member that counts. Raises WrongAnswerError."""
        value = self.said.get(name)
        if type(value) is not int or not 0 <= value < LARGEST:
            raise WrongAnswerError(f"the answer's `{name}` {WRONG[name]}")
        return value


def document(body: bytes) -> dict[str, Any]:
    """A JSON object. Raises WrongAnswerError."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        raise WrongAnswerError("the answer is no JSON") from None
    if not isinstance(found, dict):
        raise WrongAnswerError("the answer is no JSON object")
    return found


def read(model: type[BaseModel], found: dict[str, Any], most: int = 0) -> Any:
    """An answer, nothing in which is believed beyond what it is; `most`: of its files. Raises WrongAnswerError."""
    place: tuple[int | str, ...] = ("files",)
    try:
        message: Any = model.model_validate(found)
        if not most or len(message.files) <= most:
            return message
    except ValidationError as error:
        place = error.errors()[0]["loc"]
    name = place[-1] if place[-1] in WRONG and place[0] != "heads" else place[0]
    words = WRONG.get(str(name), f"is no list of at most {most} objects")
    raise WrongAnswerError(f"the answer's `{name}` {words}")
