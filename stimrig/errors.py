"""Every error that `stimrig` raises: those of identification, and those of the REST client."""

from __future__ import annotations

from stimrig.api.client.errors import (
    Conflict,
    Forbidden,
    Invalid,
    NotCompleted,
    NotFound,
    Refused,
    ServiceError,
    TooManyRequests,
    Unauthorized,
    Unavailable,
    Unreachable,
)
from stimrig.identify.errors import BadModel, BadRecord, BadRequest, Cancelled, IdentifyError, NotIdentifiable

__all__ = [
    "BadModel", "BadRecord", "BadRequest", "Cancelled", "Conflict", "Forbidden", "IdentifyError", "Invalid",
    "NotCompleted", "NotFound", "NotIdentifiable", "Refused", "ServiceError", "TooManyRequests", "Unauthorized",
    "Unavailable", "Unreachable",
]  # fmt: skip
