"""Which requests decide something, and which document's version each of them must have been made on.

Clients send the `ETag` of that document back as `If-Match` (RFC 9110, section 13.1.1; RFC 6585, section 3); a page's
form has it in a field. What each decision rests on, and where that is checked, is in tests/api/decisions.toml.
"""

from __future__ import annotations

import re
from typing import NamedTuple


class Decision(NamedTuple):
    """A request that decides."""

    method: str  # of the REST route; a page's form is posted
    path: str  # of the REST route, with names in braces; empty where only a page has it
    document: str  # whose version is sent
    form: str = ""  # address that the page's form is posted to; empty where there is none
    field: str = "seen"  # the form's field with the version
    needed: bool = True
    """False: who sends none decides on what is there now, since it can only take away, or bring back what was
    before."""


PERSON, OF_MODEL, OF_PERSON = "/v1/participants/{code}", "/models/{model_id}", "/participants/{code}"
CALIBRATION = f"{PERSON}/calibration"
MODEL_TAG = 64
"""Length of a model's tag, its SHA-256: with it a trial says with which model it was planned."""
OF_RIG = ("latch", "calibration")
"""Fields whose version the rig keeps, not the audit trail."""
DECISIONS = (
    *(Decision("POST", f"/v1{OF_MODEL}/{word}", f"/v1{OF_MODEL}", f"{OF_MODEL}/{word}")
      for word in ("approve", "undo")),
    Decision("POST", f"/v1{OF_MODEL}/reject", f"/v1{OF_MODEL}", f"{OF_MODEL}/reject", needed=False),
    *(Decision("PUT", f"{PERSON}/{word}", PERSON, f"{OF_PERSON}/{word}") for word in ("profile", "muscle")),
    *(Decision("POST", f"{PERSON}/{word}", PERSON, f"{OF_PERSON}/{word}")
      for word in ("archive", "unarchive", "recordings", "calibration", "keys")),
    Decision("POST", "/v1/tests", PERSON, f"{OF_PERSON}/tests"),
    *(Decision("POST", f"{CALIBRATION}/{path}", CALIBRATION, f"{OF_PERSON}/calibration/{form}", "calibration")
      for path, form in (("step", "step/{direction}"), ("mark", "mark/{threshold}"), ("finish", "finish"),
                           ("discard", "discard"))),
    Decision("POST", f"{PERSON}/notes/{{note_id}}/strike", f"{PERSON}/notes", f"{OF_PERSON}/notes/{{note_id}}/strike"),
    Decision("PUT", "/v1/tests/{test_id}/ran-by", "/v1/tests/{test_id}", "/tests/{test_id}/ran-by"),
    Decision("POST", "/v1/rearm", "/v1/rig", "/rearm", "latch"),
    Decision("POST", "/v1/rig/angle/pose", "/v1/rig/angle", "/rig/angle/pose"),
    Decision("PUT", "/v1/users/{name}/password", "/v1/users", "/administration/users/{name}/password"),
)  # fmt: skip
_PATHS = [
    (method, re.compile(re.sub(r"\{(\w+)\}", r"(?P<\1>[^/]+)", path)), decision)
    for decision in DECISIONS
    for method, path in ((decision.method, decision.path), ("POST", decision.form))
    if path
]


def find(method: str, path: str) -> tuple[Decision, dict[str, str]] | None:
    """The decision that a request makes, and the names in its path; None: it decides nothing."""
    for own, pattern, decision in _PATHS:
        if method == own and (found := pattern.fullmatch(path)):
            return decision, found.groupdict()
    return None
