"""Types that requests and answers share; nothing but pydantic is needed to import them."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

NoteKind = Literal["electrodes", "side", "posture", "medication", "spasm", "other"]
SETTINGS = {
    "type": "object",
    "description": "with the units and ranges that `GET /v1/sequences` gives for the sequence; the rig checks them",
    "additionalProperties": {"type": ["number", "boolean", "array", "null"], "items": {"type": "number"}},
    "examples": [{"max_pulse_width_us": 250.0, "bits": 7}],
}
"""JSON Schema of a segment's settings."""


class Scope(StrEnum):
    """Permission of a token.

    ``rearm`` is in no role and no controller's key: after a stop a person looks first. A person who signed in with a
    password and may run tests has it for the session; a program has it only where it was requested by name.
    """

    READ_LIVE = "read-live"
    RUN_TEST = "run-test"
    REARM = "rearm"
    APPROVE_MODEL = "approve-model"
    READ_MODEL = "read-model"
    ADMINISTER = "administer"
