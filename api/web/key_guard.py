"""What a controller's key opens: these routes for its participant, and nothing else.

The one place where that is decided. `Auth.identify` refuses a bound key to whoever does not ask here, so a new route is
closed to it until it stands in `OPEN`. What a trial may be is in `api.sessions.controller_trials`.
"""

from __future__ import annotations

import re

from api.models.tracked import parts
from api.people.auth import Principal, outside
from api.store import Store
from api.store.tables import Model, Recording, Test

STOP = "/v1/stop"
OPEN = [
    (method, re.compile(path), table)
    for method, path, table in (
        ("POST", STOP, None),
        ("POST", "/v1/tests", None),
        ("GET", "/v1/participants/([^/]+)/(?:model|tracking)", str),
        ("POST", "/v1/models/([^/]+)/prediction", Model),
        ("POST", "/v1/models/([^/]+)/widths", Model),
        ("GET", "/v1/tests/([^/]+)", Test),
        ("WS", "/v1/tests/([^/]+)/live", Test),
        ("GET", "/v1/recordings/([^/]+)(?:/csv)?", Recording),
    )
]
"""Method, path, and the table in whose row the participant stands; str: the path names it; None: the body does."""


def refuse_outside(store: Store, who: Principal, method: str, path: str) -> None:
    """Let pass who is bound to nobody, and a key on what it opens.

    Raises
    ------
    ApiError
        403, the same for what is another participant's, for what is not there, and for routes that no key opens.
    """
    if who.participant is not None and not _opens(store, who.participant, method, path):
        raise outside(who.participant)


def _opens(store: Store, participant: str, method: str, path: str) -> bool:
    for own_method, pattern, table in OPEN:
        found = pattern.fullmatch(path)
        if method != own_method or found is None:
            continue
        if table is None:
            return True
        if table is str:
            return found[1] == participant
        own_id = parts(found[1])[0] if table is Model else found[1]  # what is tracked from a model opens with it
        row = store.get(table, own_id)
        of_test = table is not Recording or (row is not None and row.test_id is not None)
        return row is not None and row.participant == participant and of_test
    return False
