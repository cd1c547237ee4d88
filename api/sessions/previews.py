"""Previewed plans, kept by their hash: `POST /v1/tests` with `plan_hash` starts just the plan that was shown."""

from __future__ import annotations

import asyncio
import hashlib
import json
import secrets
from dataclasses import dataclass, field
from functools import cached_property
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
    made_s: float
    made_unix_s: float
    test_id: str | None = None
    """Id of the test started from it: a second request returns the same test."""
    starting: asyncio.Lock = field(default_factory=asyncio.Lock)
    nonce: str = field(default_factory=lambda: secrets.token_hex(16))
    """Each preview has a hash of its own: one that was started or is too old stays so, whoever previews that plan."""

    @cached_property
    def hash(self) -> str:
        """Of everything that is shown and played, without the test's id, and of the nonce."""
        plan = self.planned.plan.model_dump(mode="json", exclude={"test_id"})
        text = json.dumps([self.nonce, self.body.model_dump(mode="json"), plan, self.answer], sort_keys=True)
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
        self._previews[preview.hash] = preview
        of_one = [old for old, kept in self._previews.items() if kept.body.participant == body.participant]
        for old in of_one[:-CAPACITY_OF_ONE] or list(self._previews)[:-CAPACITY]:
            del self._previews[old]
        return preview.hash

    def find(self, participant: str, plan_hash: str) -> Preview:
        """Return a preview. Raises ApiError (410): unknown, another participant's, or too old to start."""
        preview = self._previews.get(plan_hash)
        if preview is None or preview.body.participant != participant:
            raise _gone("Newer previews took its place, or the service was restarted since.")
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
