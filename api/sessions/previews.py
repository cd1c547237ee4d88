"""Previewed plans, kept by their hash: `POST /v1/tests` with `plan_hash` starts just the plan that was shown."""

from __future__ import annotations

import asyncio
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.models.places import Site, site_of
from stimrig.api.sessions.kinds import Planned
from stimrig.api.sessions.requests import TestIn
from stimrig.api.store.tables import Participant

VALID_S = 300.0
"""Validity of a preview, s."""
CAPACITY = 20
"""Previews that are kept; the oldest goes first."""


@dataclass
class Preview:
    """A plan as it was shown, and what it was made from."""

    body: TestIn
    planned: Planned
    answer: dict[str, Any]  # of the rig
    profile: dict[str, Any]
    site: Site
    made_s: float
    made_unix_s: float
    test_id: str | None = None
    """Id of the test started from it: a second request returns the same test."""
    starting: asyncio.Lock = field(default_factory=asyncio.Lock)

    @property
    def hash(self) -> str:
        """Of everything that is shown and played; not of the test's id."""
        plan = self.planned.plan.model_dump(mode="json", exclude={"test_id"})
        text = json.dumps([self.body.model_dump(mode="json"), plan, self.answer], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


class Previews:
    """The newest previews; a restart forgets them, and a person previews again."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._previews: dict[str, Preview] = {}

    def add(self, body: TestIn, planned: Planned, answer: dict[str, Any], row: Participant) -> str:
        """Store a preview and return its hash."""
        now_s, now_unix_s = self.clock.monotonic_s(), self.clock.unix_s()
        preview = Preview(body, planned, answer, dict(row.profile), site_of(row), now_s, now_unix_s)
        plan_hash = preview.hash
        self._previews.pop(plan_hash, None)
        self._previews[plan_hash] = preview
        for old in list(self._previews)[:-CAPACITY]:
            del self._previews[old]
        return plan_hash

    def find(self, participant: str, plan_hash: str) -> Preview:
        """Return a preview. Raises ApiError (410): unknown, another participant's, or too old to start."""
        preview = self._previews.get(plan_hash)
        if preview is None or preview.body.participant != participant:
            raise _gone("It is not known, or the service was restarted since.")
        # both clocks: one stands still while the machine sleeps, the other may be set
        ages_s = self.clock.monotonic_s() - preview.made_s, self.clock.unix_s() - preview.made_unix_s
        if preview.test_id is None and not all(0 <= age_s <= VALID_S for age_s in ages_s):
            raise _gone(f"It is valid for {VALID_S / 60:.0f} minutes; what it shows may have changed.")
        return preview


def refuse_changed(preview: Preview, row: Participant) -> None:
    """Raise ApiError (409) where limits or site are no longer those that the plan was made from."""
    if (preview.profile, preview.site) != (row.profile, site_of(row)):
        detail = f"Limits or site of {row.code} were changed after the preview. Nothing was started. Preview it again."
        raise ApiError(409, "changed-meanwhile", "This plan is out of date", detail)


def _gone(why: str) -> ApiError:
    return ApiError(410, "preview-gone", "This plan is not valid any more", f"{why} Nothing was started. Go back.")
