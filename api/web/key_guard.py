"""What a controller's key opens: these routes for its participant, and nothing else.

The one place where that is decided. `Auth.identify` refuses a bound key to whoever does not ask here, so a new route is
closed to it until it stands in `OPEN`. What a trial may be is in `stimrig.api.sessions.controller_trials`.
"""

from __future__ import annotations

import re

from stimrig.api.errors import ApiError
from stimrig.api.models.places import kept, site_of
from stimrig.api.models.registry import Versions
from stimrig.api.people.auth import Principal, outside
from stimrig.api.sessions.controller_trials import unapproved
from stimrig.api.store.tables import Model, Participant, Recording, Test

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
"""Method, path, and the table in whose row the participant stands; str: the path names it; None: the body does.

Of the models it is the approved one, and what was tracked from it under the approval that holds."""


def refuse_outside(versions: Versions, who: Principal, method: str, path: str) -> None:
    """Let pass who is bound to nobody, and a key on what it opens.

    Raises
    ------
    ApiError
        403: the key is of another site; or, the same for what is another participant's, for what is not there, and for
        routes that no key opens. 409: a model is asked, and none of the key's participant is approved.
    """
    if who.participant is None:
        return
    if not _opens(versions, who.participant, method, path):
        raise outside(who.participant)
    row: Participant = versions.store.get(Participant, who.participant)
    if kept((who.plan or {}).get("site")) != site_of(row):
        detail = "The participant is stimulated at another site now. A person makes a key for it."
        raise ApiError(403, "other-site", "This key is of another site", detail)


def _opens(versions: Versions, participant: str, method: str, path: str) -> bool:
    for own_method, pattern, table in OPEN:
        found = pattern.fullmatch(path)
        if method != own_method or found is None:
            continue
        if table is None:
            return True
        if table is str:
            return found[1] == participant
        if table is Model:
            return _approved(versions, participant, found[1])
        row = versions.store.get(table, found[1])
        of_test = table is not Recording or (row is not None and row.test_id is not None)
        return row is not None and row.participant == participant and of_test
    return False


def _approved(versions: Versions, participant: str, model_id: str) -> bool:
    """Whether a person allows this version today: the approved one, or one tracked from it. Raises ApiError (409)."""
    approval = versions.approved(participant)
    if approval is None:
        raise unapproved(participant)
    own = re.escape(approval.model_id)
    return re.fullmatch(rf"{own}(\.{approval.id}\.[0-9]+)?", model_id) is not None
