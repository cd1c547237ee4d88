"""What a centre answers, read with suspicion: nothing in it is believed beyond what it is."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

from stimrig.api.outbox.chain import Position
from stimrig.api.outbox.errors import WrongAnswerError
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.store.hashes import GENESIS

SHA256 = re.compile(r"[0-9a-f]{64}")
LONGEST_TEXT = 200
LARGEST = 2**53


@dataclass(frozen=True)
class Wanted:
    """A file that the centre lacks, and how much of it it has."""

    sha256: str
    size: int
    have: int


@dataclass(frozen=True)
class Progress:
    """What the centre has of a file."""

    have: int
    whole: bool


def document(body: bytes) -> dict[str, Any]:
    """A JSON object."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        raise WrongAnswerError("the answer is no JSON") from None
    if not isinstance(found, dict):
        raise WrongAnswerError("the answer is no JSON object")
    return found


def position(found: dict[str, Any]) -> Position:
    """`seq` and `hash`."""
    given = Position(whole_number(found, "seq"), hash_of(found, "hash"))
    if (given.seq == 0) != (given.hash == GENESIS):
        raise WrongAnswerError("the answer's `seq` and `hash` do not belong together")
    return given


def wanted(found: dict[str, Any], limit: int) -> list[Wanted]:
    """`files`: what the centre lacks."""
    files = found.get("files")
    if not isinstance(files, list) or len(files) > limit or not all(isinstance(each, dict) for each in files):
        raise WrongAnswerError(f"the answer's `files` is no list of at most {limit} objects")
    return [
        Wanted(hash_of(each, "sha256"), whole_number(each, "bytes"), whole_number(each, "have_bytes")) for each in files
    ]


def receipts(found: dict[str, Any]) -> list[Receipt]:
    """`heads`: what it countersigned."""
    try:
        given = [Receipt.model_validate(each) for each in found["heads"]]
    except (KeyError, TypeError, ValueError):
        raise WrongAnswerError("the answer's `heads` are no receipts") from None
    if not all(one.key and one.holds for one in given):
        raise WrongAnswerError("the answer's `heads` are not as the centre signed them")
    return given


def progress(found: dict[str, Any]) -> Progress:
    """`have_bytes` and `whole`."""
    whole = found.get("whole")
    if not isinstance(whole, bool):
        raise WrongAnswerError("the answer's `whole` is neither true nor false")
    return Progress(whole_number(found, "have_bytes"), whole)


def whole_number(found: dict[str, Any], name: str) -> int:
    """A number that counts something."""
    value = found.get(name)
    if type(value) is not int or not 0 <= value < LARGEST:
        raise WrongAnswerError(f"the answer's `{name}` is no whole number from 0 on")
    return value


def hash_of(found: dict[str, Any], name: str) -> str:
    """A SHA-256."""
    value = found.get(name)
    if not isinstance(value, str) or not SHA256.fullmatch(value):
        raise WrongAnswerError(f"the answer's `{name}` is no SHA-256")
    return value


def text(value: object) -> str:
    """Words of the centre for people: on one line, and not many."""
    words = " ".join("".join(sign if sign.isprintable() else " " for sign in str(value or "")).split())
    return words if len(words) <= LONGEST_TEXT else words[: LONGEST_TEXT - 1] + "…"
