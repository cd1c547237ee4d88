"""Every error that `stimrig` raises: of identification, of the REST client, and of verbs that go on elsewhere."""

from __future__ import annotations

from stimrig.api.cli.errors import CommandError, InputError, LaunchError
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
    "BadModel", "BadRecord", "BadRequest", "Cancelled", "CommandError", "Conflict", "Forbidden", "IdentifyError",
    "InputError", "Invalid", "LaunchError", "NotCompleted", "NotFound", "NotIdentifiable", "Refused", "ServiceError",
    "TooManyRequests", "Unauthorized", "Unavailable", "Unreachable",
]  # fmt: skip
