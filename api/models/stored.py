"""A stored MODEL.json: the bytes that were stored, or a line that says that they are damaged."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.store.tables import Model


def whole(row: Model) -> bytes:
    """A version's bytes, for the controller and for files. Raises ApiError (500) where they are damaged."""
    if hashlib.sha256(row.document).hexdigest() != row.etag:
        detail = (
            f"{row.id} is no longer what was stored (its checksum differs). Restore the database from a backup, or fit "
            "its recording again."
        )
        raise ApiError(500, "model-damaged", "The stored model is damaged", detail)
    return row.document


def read(row: Model) -> dict[str, Any]:
    """A version's document. Raises ApiError (500) where it is damaged."""
    return json.loads(whole(row))


def text(row: Model) -> str:
    """A version's document as workers are given it. Raises ApiError (500) where it is damaged."""
    return whole(row).decode()
