"""Tests that stop themselves: what they can reach, their plan, who follows them, and what became of them."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.models import stored
from stimrig.api.models.places import Place, differ, place_of, site_of
from stimrig.api.models.registry import Versions
from stimrig.api.sessions import adaptive_plan
from stimrig.api.sessions.adaptive import Follower, Told
from stimrig.api.sessions.adaptive_plan import ADAPTIVE, PIECE_S, Planned
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store.tables import Participant, Test
from stimrig.api.workers.adviser import Adviser
from stimrig.rig.messages import SAFE_END_S, FinishedEvent, PreviewRequest, TestPlan

KEPT = 20
"""Outlooks that are remembered: the question before a test and its start need the same one."""
MOST_MODELS = 10
"""Sessions from which is learnt how much a person changes between two."""
ENDS = {"torque_time": "torque-time", "plan": "fixed-rest"}
"""Why a test ended, by the rig's reason, where it is told by another name."""


class AdaptiveTests:
    """All of it; at most one test runs.

    Parameters
    ----------
    tell : callable
        Called with a message for the live channel.
    """

    def __init__(
        self, clock: Clock, rig: RigClient, versions: Versions, adviser: Adviser, tell: Callable[[dict[str, Any]], None]
    ) -> None:
        self.clock, self.rig, self.versions, self.adviser, self.tell = clock, rig, versions, adviser, tell
        self.follower: Follower | None = None
        self._task: asyncio.Task[None] | None = None
        self._outlooks: OrderedDict[str, dict[str, Any]] = OrderedDict()
        self._looking = asyncio.Lock()

    # ---- before ----------------------------------------------------------------------------------------------

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:
        """The plan with its bounds and its fixed plan; as it is where the test is of another kind.

        Raises
        ------
        ApiError
            422: the target cannot be reached, and nobody said that the test is to be played anyway; what the rig
            refuses. 500: the worker died.
        """
        if body.kind != ADAPTIVE:
            return Planned(plan)
        bounds = adaptive_plan.bounds_of(body, plan)
        how = {
            "target": body.target.model_dump(),
            "playable_s": bounds.max_duration_s - SAFE_END_S, "max_torque_time_nm_s": bounds.max_torque_time_nms,
            "largest_us": plan.largest_us, "pulse_rate_hz": plan.pulse_rate_hz,
            "models": await asyncio.to_thread(self._models_for, plan),
        }  # fmt: skip
        found = await self._outlook({**how, "max_torque_nm": plan.stopping_torque_nm})
        default = await self.rig.ask(PreviewRequest(plan=plan, recruitment=None), timeout_s=preview_s)
        segments = adaptive_plan.fixed_plan(found["opening_us"], default, plan.pulse_rate_hz, bounds)
        if not found["reach"]["reachable"] and not body.anyway:
            raise out_of_reach(found["reach"])
        plan = plan.model_copy(update={"segments": segments, "adaptive": bounds})
        return Planned(plan, how, {**found["reach"], "known": found["known"]})

    async def _outlook(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """What the test can reach. One after the other, so that a test which begins waits for one at most."""
        name = hashlib.sha256(repr(wanted).encode()).hexdigest()
        if name in self._outlooks:
            return self._outlooks[name]
        async with self._looking:
            if name not in self._outlooks:
                if self._task is not None and not self._task.done():
                    detail = "What a test can reach is computed once the one that runs has ended."
                    raise ApiError(409, "rig-busy", "Another test is running", detail)
                self._outlooks[name] = await self.adviser.ask("adaptive_outlook", **wanted)
                while len(self._outlooks) > KEPT:
                    self._outlooks.popitem(last=False)
            return self._outlooks[name]

    def _models_for(self, plan: TestPlan) -> list[str]:
        person = self.versions.store.get(Participant, plan.participant)
        return self._models(plan.participant, (*site_of(person), plan.profile.current_ma))

    def _models(self, participant: str, place: Place) -> list[str]:
        """The participant's approved models, oldest first.

        Without those that are damaged, and those of tests at another place: they say nothing of this one.
        """
        rows = self.versions.all_approved_ones(participant)
        tests = self.versions.store.all(Test, Test.recording_id.in_([row.recording_id for row in rows]))
        elsewhere = {test.recording_id for test in tests if differ(place_of(test), place)}
        found = []
        for row in [row for row in rows if row.recording_id not in elsewhere][-MOST_MODELS:]:
            with contextlib.suppress(ApiError):
                found.append(stored.text(row))
        return found

    # ---- while it plays --------------------------------------------------------------------------------------

    def begin(self, planned: Planned) -> str:
        """Follow a test that is about to start; the key with which it is started. Empty for another kind of test."""
        how, reach = planned.how, planned.reach
        if how is None or reach is None:
            return ""
        self.leave()
        self.follower = follower = Follower(planned.plan, how, reach, self.rig, self.adviser, self.clock, self._tell)
        self._task = asyncio.create_task(follower.run(self.rig.path))
        return follower.key

    def _tell(self) -> None:
        follower = self.follower
        if follower is not None:
            self.tell({"type": "adaptive", "test_id": follower.plan.test_id, **self._view(follower)})

    def said_enough(self, test_id: str) -> None:
        """A person has ended it well."""
        if (follower := self._of(test_id)) is not None:
            follower.told.state, follower.told.ended = "ending", follower.told.ended or "enough"
            self._tell()

    def leave(self) -> None:
        """Follow no test any more."""
        if self._task is not None:
            self._task.cancel()
        self._task, self.follower = None, None

    async def close(self) -> None:
        """Let everything go."""
        task = self._task
        self.leave()
        if task is not None:
            await asyncio.gather(task, return_exceptions=True)
        await self.adviser.close()

    # ---- what became of it -----------------------------------------------------------------------------------

    def _of(self, test_id: str) -> Follower | None:
        return self.follower if self.follower is not None and self.follower.plan.test_id == test_id else None

    def outcome(self, row: Test, event: FinishedEvent) -> dict[str, Any]:
        """What is kept of a test that stopped itself, by the name it has in the summary; nothing of another one."""
        if row.kind != ADAPTIVE:
            return {}
        rigs, follower = str(event.summary.get("ended_by") or event.outcome), self._of(row.id)
        told = self._view(follower) if follower is not None else unfollowed(row)
        ended = told["ended"] if rigs == "enough" and told["ended"] else ENDS.get(rigs, rigs)
        if rigs == "limit" and told["max_duration_s"] - event.summary["duration_s"] < PIECE_S:
            ended = "time"  # another piece of the fixed plan would have been too long
        measured_nm_s = event.summary.get("torque_time_nms", told["torque_time_nm_s"])
        return {"adaptive": {**told, "torque_time_nm_s": measured_nm_s, "state": "ended", "ended": ended}}

    def fit_options(self, row: Test) -> dict[str, Any]:
        """How the recording is fitted: a short one needs to know what a curve looks like, or looked like last time.

        One that holds the whole default test needs no such help: its fixed plan was played, and was not cut off by a
        bound.
        """
        if row.kind != ADAPTIVE:
            return {}
        ended = (row.summary.get("adaptive") or {}).get("ended")
        planned = [segment["name"] for segment in (row.plan.get("preview") or {}).get("segments") or []]
        if ended == "fixed-rest" and "validate" in planned:
            return {}
        return {"recruitment": "near-sigmoid", "models": self._models(row.participant, place_of(row))}

    def document(self, row: Test) -> dict[str, Any] | None:
        """How the test stands or what became of it; None of a test of another kind."""
        if row.kind != ADAPTIVE:
            return None
        if kept := row.summary.get("adaptive"):
            return kept
        follower = self._of(row.id)
        return self._view(follower) if follower is not None else unfollowed(row)

    def _view(self, follower: Follower) -> dict[str, Any]:
        bounds = follower.plan.adaptive
        assert bounds is not None
        limits = {"max_duration_s": bounds.max_duration_s, "max_torque_time_nm_s": bounds.max_torque_time_nms}
        return {**limits, "torque_time_nm_s": follower.torque_time_nm_s, **asdict(follower.told)}


def unfollowed(row: Test) -> dict[str, Any]:
    """Of a test that this service does not follow: it was restarted meanwhile, or the test never began."""
    bounds = row.plan.get("adaptive") or {}
    begun = row.state not in ("requested", "refused")
    why = "The fixed plan plays on: the service was restarted during the test." if begun else ""
    return {
        "max_duration_s": bounds.get("max_duration_s"),
        "max_torque_time_nm_s": bounds.get("max_torque_time_nms"),
        "torque_time_nm_s": None,
        **asdict(Told(row.plan.get("target") or {}, row.plan.get("reach"), state="fixed", problem=why)),
    }


def out_of_reach(reach: dict[str, Any]) -> ApiError:
    """422: said before the first pulse, with what can be reached."""
    detail = (
        f'{reach["words"]} Nothing was started. Allow more torque-time or time, ask for less, or send "anyway": true '
        "to play it all the same."
    )
    return ApiError(422, "out-of-reach", "The target cannot be reached", detail, reach=reach)
