"""Which requests decide something, and which document's `ETag` each sends as `If-Match`: for clients and tests."""

from __future__ import annotations

import re
from typing import NamedTuple


class Decision(NamedTuple):
    """A request that decides; names in braces stand for parts of its path."""

    method: str
    path: str
    document: str


PERSON, MODEL, CALIBRATION = "/v1/participants/{code}", "/v1/models/{model_id}", "/v1/participants/{code}/calibration"
DECISIONS = (
    *(Decision("POST", f"{MODEL}/{word}", MODEL) for word in ("approve", "reject", "undo")),
    *(Decision("PUT", f"{PERSON}/{word}", PERSON) for word in ("profile", "muscle")),
    *(Decision("POST", f"{PERSON}/{word}", PERSON)
      for word in ("archive", "unarchive", "recordings", "calibration", "keys")),
    *(Decision("POST", f"{CALIBRATION}/{word}", CALIBRATION) for word in ("step", "mark", "finish", "discard")),
    Decision("POST", "/v1/tests", PERSON),
    Decision("PUT", "/v1/tests/{test_id}/ran-by", "/v1/tests/{test_id}"),
    Decision("POST", "/v1/rearm", "/v1/rig"),
    Decision("POST", "/v1/rig/angle/pose", "/v1/rig/angle"),
    Decision("PUT", "/v1/users/{name}/password", "/v1/users"),
)  # fmt: skip
_PATHS = [(one, re.compile(re.sub(r"\{(\w+)\}", r"(?P<\1>[^/]+)", one.path))) for one in DECISIONS]


def find(method: str, path: str) -> tuple[Decision, dict[str, str]] | None:
    """Return the decision that a request makes, and the names in its path; None: it decides nothing."""
    for decision, pattern in _PATHS:
        if method == decision.method and (found := pattern.fullmatch(path)):
            return decision, found.groupdict()
    return None
