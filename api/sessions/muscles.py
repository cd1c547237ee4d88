"""A test of several channels at one joint: its plan. It plays, is watched and gives a model as a plain test does."""

from __future__ import annotations

import asyncio

from stimrig.api.sessions import channels
from stimrig.api.sessions.kinds import Kind, Planned
from stimrig.api.sessions.requests import MUSCLES, TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import Store
from stimrig.api.store.tables import Participant
from stimrig.rig.messages import TestPlan


class MusclesTests(Kind):
    """Plans them: all channels of the rig, each with the participant's profile there. The rig has their protocol."""

    names = (MUSCLES,)

    def __init__(self, rig: RigClient, store: Store) -> None:
        super().__init__(rig)
        self.store = store

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:  # noqa: ARG002
        """As `Kind`. Raises ApiError: 409 the rig has one channel; 422 the participant has no limits on one."""
        row: Participant = await asyncio.to_thread(self.store.get, Participant, plan.participant)
        return Planned(*channels.for_all(plan, row, self.rig.status))
