"""The requests that decide, and the document whose `ETag` each sends as `If-Match`: for clients and tests."""

from __future__ import annotations

import re
from typing import Any

PERSON, MODEL, CALIBRATION = "/v1/participants/{code}", "/v1/models/{model_id}", "/v1/participants/{code}/calibration"
DECISIONS = {
    **{f"POST {MODEL}/{word}": MODEL for word in ("approve", "reject")},
    **{f"PUT {PERSON}/{word}": PERSON for word in ("profile", "muscle")},
    **{f"POST {PERSON}/{word}": PERSON for word in ("recordings", "calibration", "keys")},
    **{f"POST {CALIBRATION}/{word}": CALIBRATION for word in ("step", "mark", "finish", "discard")},
    "POST /v1/tests": PERSON,
    "POST /v1/rearm": "/v1/rig",
    "POST /v1/rig/angle/pose": "/v1/rig/angle",
    "PUT /v1/users/{name}/password": "/v1/users",
}
_PATTERNS = [(re.compile(re.sub(r"\{(\w+)\}", r"(?P<\1>[^/]+)", path)), named) for path, named in DECISIONS.items()]


def document_of(method: str, path: str, body: Any = None) -> str:
    """Return the document whose version a request must name; empty where it decides nothing.

    A test is begun on the participant in its body; without one the service says what is wrong with the request.
    """
    for pattern, document in _PATTERNS:
        if request := pattern.fullmatch(f"{method} {path.partition('?')[0]}"):
            begun_on = {"code": body["participant"]} if isinstance(body, dict) and "participant" in body else {}
            names = begun_on | request.groupdict()
            return document.format(**names) if names or "{" not in document else ""
    return ""
