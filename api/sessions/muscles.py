"""A test of several channels at one joint: its plan. It plays, is watched and gives a model as a plain test does."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

from stimrig.api.sessions import channels
from stimrig.api.sessions.kinds import Kind, Planned
from stimrig.api.sessions.requests import MUSCLES, TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import Store
from stimrig.api.store.tables import Participant
from stimrig.rig.messages import ChannelPlan, ChannelSequence, Profile, SegmentPlan, TestPlan

__all__ = ["MUSCLES", "MusclesTests", "segments"]
REST_S, BETWEEN_S = 1.0, 2.0
RAMP_S = 4.0
"""Up, and as long down again."""
ALONE_S, TOGETHER_S = 3.0, 6.0
"""Of the pulses that are held out, while one muscle works and while all do."""
SEEDS = (1, 84, 43, 108, 22, 65, 96, 11)
"""Where in its period each channel's random sequence starts: far from the others', so that none looks like another."""


class MusclesTests(Kind):
    """Plans them."""

    names = (MUSCLES,)

    def __init__(self, rig: RigClient, store: Store) -> None:
        super().__init__(rig)
        self.store = store

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:  # noqa: ARG002
        """As `Kind`. Raises ApiError: 409 the rig has one channel; 422 the participant has no limits on one."""
        row: Participant = await asyncio.to_thread(self.store.get, Participant, plan.participant)
        playing = channels.needed(row, self.rig.status)
        plans = [ChannelPlan(name=one.name, profile=Profile(**one.profile)) for one in playing]
        plans[0].profile = plan.profile
        names = [one.name for one in playing]
        sites = {one.name: list(one.site) for one in playing if one.key}
        return Planned(plan.model_copy(update={"channels": plans, "segments": segments(names)}), {"sites": sites})


def segments(names: list[str]) -> list[SegmentPlan]:
    """The default test: all at random together, a ramp of each by itself, and checks of each alone and of all.

    Every channel's widest pulse is the one that its own limits allow.
    """
    seeds = dict(zip(names, SEEDS, strict=False))
    checks = {name: _plays("multilevel", duration_s=TOGETHER_S, seed=seed) for name, seed in seeds.items()}
    return [
        _rest(REST_S),
        _segment("prbs", {name: _plays("prbs", seed=seed) for name, seed in seeds.items()}),
        *_each("ramp", names, _plays("ramp", up_s=RAMP_S, down_s=RAMP_S), BETWEEN_S),
        *_each("validate", names, _plays("multilevel", duration_s=ALONE_S), REST_S),
        _rest(REST_S),
        _segment("validate", checks),
        _rest(BETWEEN_S),
    ]


def _each(name: str, names: Iterable[str], plays: ChannelSequence, rest_s: float) -> list[SegmentPlan]:
    """The same with each channel in turn, after a rest."""
    return [part for channel in names for part in (_rest(rest_s), _segment(name, {channel: plays}))]


def _segment(name: str, played: dict[str, ChannelSequence]) -> SegmentPlan:
    """The first channel rests where it is not named, as the others do; all last as long as the longest."""
    return SegmentPlan(name=name, sequence="rest", settings={"duration_s": REST_S}, channels=played)


def _plays(sequence: str, **settings: Any) -> ChannelSequence:
    return ChannelSequence(sequence=sequence, settings=settings)


def _rest(duration_s: float) -> SegmentPlan:
    return SegmentPlan(name="rest", sequence="rest", settings={"duration_s": duration_s})
