"""Previewed plans, kept by their hash: `POST /v1/tests` with `plan_hash` starts just the plan that was shown."""

from __future__ import annotations

import asyncio
import hashlib
import json
import secrets
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
CAPACITY, CAPACITY_OF_ONE = 60, 20
"""Previews that are kept of all participants, and of each; the oldest goes first."""


@dataclass
class Preview:
    """A plan as it was shown, and what it was made from."""

    body: TestIn
    planned: Planned
    answer: dict[str, Any]  # of the rig
    profile: dict[str, Any]
    site: Site
    made_s: tuple[float, float]
    """By both clocks: one stands still while the machine sleeps, the other may be set."""
    test_id: str | None = None
    """Id of the test started from it: a second request returns the same test."""
    starting: asyncio.Lock = field(default_factory=asyncio.Lock)


class Previews:
    """The newest previews; a restart forgets them, and a person previews again."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._previews: dict[str, Preview] = {}

    def _now_s(self) -> tuple[float, float]:
        return self.clock.monotonic_s(), self.clock.unix_s()

    def add(self, body: TestIn, planned: Planned, answer: dict[str, Any], row: Participant) -> str:
        """Store a preview and return its hash: another one each time, so that one that was started or is too old stays
        so, whoever previews that plan."""
        plan = planned.plan.model_dump(mode="json", exclude={"test_id"})
        text = json.dumps([secrets.token_hex(16), plan, answer], sort_keys=True)
        plan_hash = hashlib.sha256(text.encode()).hexdigest()
        self._previews[plan_hash] = Preview(body, planned, answer, dict(row.profile), site_of(row), self._now_s())
        of_one = [old for old, preview in self._previews.items() if preview.body.participant == body.participant]
        for old in of_one[:-CAPACITY_OF_ONE] or list(self._previews)[:-CAPACITY]:
            del self._previews[old]
        return plan_hash

    def find(self, participant: str, plan_hash: str) -> Preview:
        """Return a preview. Raises ApiError (410): unknown, another participant's, or too old to start."""
        preview, why = self._previews.get(plan_hash), ""
        if preview is None or preview.body.participant != participant:
            why = "Newer previews took its place, or the service was restarted since."
        elif preview.test_id is None:
            ages_s = [now - made_s for now, made_s in zip(self._now_s(), preview.made_s, strict=True)]
            if not all(0 <= age_s <= VALID_S for age_s in ages_s):
                why = f"It is valid for {VALID_S / 60:.0f} minutes; what it shows may have changed."
        if preview is None or why:
            detail = f"{why} Nothing was started. Go back."
            raise ApiError(410, "preview-gone", "This plan is not valid any more", detail)
        return preview


def refuse_changed(preview: Preview, row: Participant) -> None:
    """Raise ApiError (409) where limits or site are no longer those that the plan was made from."""
    if (preview.profile, preview.site) != (row.profile, site_of(row)):
        detail = f"Limits or site of {row.code} were changed after the preview. Nothing was started. Preview it again."
        raise ApiError(409, "changed-meanwhile", "This plan is out of date", detail)
