"""Tests that stop themselves: what they can reach, their plan, who follows them, and what became of them.

The fixed plan plays where nobody chooses in time.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.jobs.pool import Pool
from stimrig.api.models import stored_model
from stimrig.api.models.places import Place, differ, place_of, site_of
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.adaptive_follower import AdaptiveStatus, Follower
from stimrig.api.sessions.kinds import AT_STOPPING_TORQUE_S, Planned, Send, Watched, begun
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store.tables import Participant, Test
from stimrig.identify.records.record import HELD_OUT
from stimrig.rig.messages import SAFE_END_S, AdaptivePlan, FinishedEvent, SegmentPlan, TestPlan
from stimrig.rig.requests import PreviewRequest

ADAPTIVE = "adaptive"
"""Kind of test."""
MOST_OUTLOOKS = 20
"""Outlooks that are remembered: the question before a test and its start need the same one."""
MOST_MODELS = 10
"""Sessions from which is learnt how much a person changes between two."""
DURATION_S = 50.0
"""The longest test, where nobody says: the opening, some ten seconds of pieces, then the whole default test fit in."""
TAIL_S = 0.4
"""Silence behind the opening: when it ends, enough was measured to decide what follows."""
PATIENCE_S = 3.0
"""Rest in a row that a late answer may cost; it needs no dose. Then the fixed plan plays on."""
PIECE_S = 2.0
"""The fixed plan is cut into pieces of this length, so that a late answer costs no more."""


class AdaptiveTests(Watched):
    """All of them. `adviser`: says what a test can reach, and what to play next."""

    names, part = (ADAPTIVE,), "adaptive"
    ends: ClassVar[Mapping[str, str]] = {"torque_time": "torque-time", "plan": "fixed-rest"}

    def __init__(self, clock: Clock, rig: RigClient, versions: Versions, adviser: Pool, send: Send) -> None:
        super().__init__(clock, rig, versions, send)
        self.adviser = adviser
        self._outlooks: OrderedDict[str, dict[str, Any]] = OrderedDict()
        self._outlook_lock = asyncio.Lock()

    # ---- before ----------------------------------------------------------------------------------------------

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:
        """The plan with its bounds and its fixed plan.

        Raises ApiError: 422: the target cannot be reached, and nobody said that the test is to be played anyway; what
        the rig refuses. 500: the worker died.
        """
        given_s, given_nm_s = body.max_duration_s, body.max_torque_time_nm_s
        bounds = AdaptivePlan(
            max_duration_s=DURATION_S if given_s is None else given_s,
            max_torque_time_nms=AT_STOPPING_TORQUE_S * plan.stopping_torque_nm if given_nm_s is None else given_nm_s,
            patience_s=PATIENCE_S,
        )
        how = {
            "target": body.target.model_dump(),
            "playable_s": bounds.max_duration_s - SAFE_END_S, "max_torque_time_nm_s": bounds.max_torque_time_nms,
            "largest_us": plan.largest_us, "pulse_rate_hz": plan.pulse_rate_hz,
            "models": await asyncio.to_thread(self._known, plan),
        }  # fmt: skip
        outlook = await self._outlook({**how, "max_torque_nm": plan.stopping_torque_nm})
        default = await self.rig.ask(PreviewRequest(plan=plan, recruitment=None), timeout_s=preview_s)
        segments = fixed_plan(outlook["opening_us"], default, plan.pulse_rate_hz, bounds)
        if not outlook["reach"]["reachable"] and not body.anyway:
            raise out_of_reach(outlook["reach"])
        plan = plan.model_copy(update={"segments": segments, "adaptive": bounds})
        reach = {**outlook["reach"], "known": outlook["known"]}
        return Planned(plan, {"target": how["target"], "reach": reach, "bounds": bounds.model_dump()}, how)

    async def _outlook(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Estimate what the test can reach. Serialised: a starting test waits for at most one estimate."""
        name = hashlib.sha256(repr(wanted).encode()).hexdigest()
        if name in self._outlooks:
            return self._outlooks[name]
        async with self._outlook_lock:
            if name not in self._outlooks:
                if self.watching:
                    detail = "What a test can reach is computed once the one that runs has ended."
                    raise ApiError(409, "rig-busy", "Another test is running", detail)
                self._outlooks[name] = await self.adviser.submit("adaptive_outlook", **wanted).result
                while len(self._outlooks) > MOST_OUTLOOKS:
                    self._outlooks.popitem(last=False)
            return self._outlooks[name]

    def _known(self, plan: TestPlan) -> list[str]:
        """List the participant's models at the place of a plan, oldest first."""
        person = self.versions.store.get(Participant, plan.participant)
        return self._models(plan.participant, (*site_of(person), plan.profile.current_ma))

    def _models(self, participant: str, place: Place) -> list[str]:
        """The participant's approved models, oldest first.

        Without those that are damaged, and those of tests at another place: they say nothing of this one.
        """
        rows = self.versions.all_approved_ones(participant)
        of_rows = self.versions.store.all(Test, Test.recording_id.in_([row.recording_id for row in rows]))
        tests = {test.recording_id: test for test in of_rows}
        texts = []
        pairs = [(row, tests.get(row.recording_id)) for row in rows]
        here = [row for row, test in pairs if test is None or not differ(place_of(test), place)]
        for row in here[-MOST_MODELS:]:
            with contextlib.suppress(ApiError):
                texts.append(stored_model.text(row))
        return texts

    # ---- while it plays, and after it ------------------------------------------------------------------------

    def begin(self, planned: Planned) -> str:
        """As `Kind`."""
        assert planned.how is not None
        follower = Follower(
            planned.plan, planned.how, planned.extra["reach"], self.rig, self.adviser, self.clock, self.publish
        )
        self.watch(follower)
        return follower.key

    async def close(self) -> None:
        """As `Kind`."""
        await super().close()
        await self.adviser.close()

    def end_of(self, row: Test, event: FinishedEvent, rigs: str, standing: Mapping[str, Any]) -> str:  # noqa: ARG002
        """Where another piece of the fixed plan would have been too long, the time has ended it."""
        by_time = rigs == "limit" and standing["max_duration_s"] - event.summary["duration_s"] < PIECE_S
        return "time" if by_time else ""

    def fit_options(self, row: Test) -> dict[str, Any]:
        """A short recording needs to know what a curve looks like, or looked like last time.

        One that holds the whole default test needs no such help: its fixed plan was played, and was not cut off by a
        bound.
        """
        ended = (row.summary.get("adaptive") or {}).get("ended")
        planned = [segment["name"] for segment in (row.plan.get("preview") or {}).get("segments") or []]
        if ended == "fixed-rest" and HELD_OUT in planned:
            return {}
        return {"recruitment": "near-sigmoid", "models": self._models(row.participant, place_of(row))}

    def unwatched(self, row: Test) -> dict[str, Any]:
        """As `Watched`."""
        bounds = row.plan.get("adaptive") or {}
        why = "The fixed plan plays on: the service was restarted during the test." if begun(row) else ""
        return {
            "max_duration_s": bounds.get("max_duration_s"),
            "max_torque_time_nm_s": bounds.get("max_torque_time_nms"),
            "torque_time_nm_s": None,
            **asdict(AdaptiveStatus(row.plan.get("target") or {}, row.plan.get("reach"), state="fixed", problem=why)),
        }


def fixed_plan(
    opening_us: Sequence[float], default: dict[str, Any], rate_hz: float, bounds: AdaptivePlan
) -> list[SegmentPlan]:
    """The opening, then the default test in short pieces, as many as the bounds leave room for.

    `opening_us`: the opening's widths, one for each pulse, µs; `default`: the rig's preview of the default test. Raises
    ApiError: 422: there is no room for the opening.
    """
    opening = [*opening_us, *[0.0] * round(TAIL_S * rate_hz)]
    room = round((bounds.max_duration_s - SAFE_END_S) * rate_hz) - len(opening)
    if not opening_us or room < 0:
        detail = (
            f"A test of at most {bounds.max_duration_s:g} s and {bounds.max_torque_time_nms:g} N·m·s has no room for a "
            "first look at the muscle. Nothing was started. Allow more."
        )
        raise ApiError(422, "out-of-reach", "The target cannot be reached", detail)
    segments = [_segment("opening", opening)]
    for name, widths in _pieces(default, rate_hz):
        room -= len(widths)
        if room < 0:
            break
        segments.append(_segment(name, widths))
    return segments


def _pieces(default: dict[str, Any], rate_hz: float) -> Iterator[tuple[str, list[float]]]:
    """Name and widths of each piece, the rest at the start left out: the opening ends with one."""
    widths, piece = default["pulse_width_us"], round(PIECE_S * rate_hz)
    for number, segment in enumerate(default["segments"]):
        first, end = round(segment["start_s"] * rate_hz), round(segment["end_s"] * rate_hz)
        if number or any(widths[first:end]):
            for start in range(first, end, piece):
                yield segment["name"], widths[start : min(start + piece, end)]


def _segment(name: str, widths: list[float]) -> SegmentPlan:
    return SegmentPlan(name=name, sequence="widths", settings={"pulse_width_us": widths, "jumps": True})


def out_of_reach(reach: dict[str, Any]) -> ApiError:
    """422: said before the first pulse, with what can be reached."""
    detail = (
        f'{reach["words"]} Nothing was started. Allow more torque-time or time, ask for less, or send "anyway": true '
        "to play it all the same."
    )
    return ApiError(422, "out-of-reach", "The target cannot be reached", detail, reach=reach)
