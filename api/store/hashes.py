"""Texts that are kept: as every database holds them, their SHA-256, and where every chain of hashes begins."""

from __future__ import annotations

import hashlib
import json
from typing import Any

GENESIS = "0" * 64


def canonical(value: Any) -> str:
    """JSON with sorted keys and no spaces: what is hashed. Raises ValueError for what has no such text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest(text: str) -> str:
    """SHA-256 in hex. Raises ValueError where UTF-8 cannot hold the text."""
    return hashlib.sha256(text.encode()).hexdigest()


def storable(text: str) -> str:
    """The text without what PostgreSQL or UTF-8 does not take, so that what somebody sent can be written down."""
    return text.replace("\x00", "\ufffd").encode("utf-8", "replace").decode()
