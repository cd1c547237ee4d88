"""Tests that stop themselves: what they can reach, their plan, who follows them, and what became of them.

The fixed plan plays where nobody chooses in time.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.jobs.pool import Pool
from stimrig.api.models import stored_model
from stimrig.api.models.places import Place, differ, place_of, site_of
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.adaptive_follower import AdaptiveStatus, Follower
from stimrig.api.sessions.kinds import AT_STOPPING_TORQUE_S, Planned, Send, Watched
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store.tables import Participant, Test
from stimrig.identify.records.record import HELD_OUT
from stimrig.rig.messages import SAFE_END_S, AdaptivePlan, FinishedEvent, SegmentPlan, TestPlan
from stimrig.rig.requests import PreviewRequest

ADAPTIVE = "adaptive"
"""Kind of test."""
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
    status_type, watching, alone = AdaptiveStatus, "choosing", "fixed"
    left_alone = "The fixed plan plays on"

    def __init__(self, clock: Clock, rig: RigClient, versions: Versions, adviser: Pool, send: Send) -> None:
        super().__init__(clock, rig, versions, send)
        self.adviser = adviser
        self._last: tuple[Any, dict[str, Any]] = None, {}
        self._outlook_lock = asyncio.Lock()

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:
        """The plan with its bounds and its fixed plan.

        Raises ApiError: 422: the target cannot be reached, and nobody said that the test is to be played anyway; what
        the rig refuses. 500: the worker died.
        """
        bounds = AdaptivePlan(
            max_duration_s=body.max_duration_s or DURATION_S,
            max_torque_time_nms=body.max_torque_time_nm_s or AT_STOPPING_TORQUE_S * plan.stopping_torque_nm,
            patience_s=PATIENCE_S,
        )

        def known() -> list[str]:
            person = self.versions.store.get(Participant, plan.participant)
            return self._models(plan.participant, (*site_of(person), plan.profile.current_ma))

        how = {
            "target": body.target.model_dump(),
            "playable_s": bounds.max_duration_s - SAFE_END_S, "max_torque_time_nm_s": bounds.max_torque_time_nms,
            "largest_us": plan.largest_us, "pulse_rate_hz": plan.pulse_rate_hz,
            "models": await asyncio.to_thread(known),
        }  # fmt: skip
        outlook = await self._outlook({**how, "max_torque_nm": plan.stopping_torque_nm})
        default = await self.rig.ask(PreviewRequest(plan=plan, recruitment=None), timeout_s=preview_s)
        segments = fixed_plan(outlook["opening_us"], default, plan.pulse_rate_hz, bounds)
        reach = outlook["reach"]
        if not reach["reachable"] and not body.anyway:
            words = f"{reach['words']} Nothing was started. Allow more torque-time or time, ask for less, or send "
            raise out_of_reach(f'{words}"anyway": true to play it all the same.', reach=reach)
        plan = plan.model_copy(update={"segments": segments, "adaptive": bounds})
        return Planned(plan, {"target": how["target"], "reach": reach, "bounds": bounds.model_dump()}, how)

    async def _outlook(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Estimate what the test can reach; the last estimate is kept, for the start after a preview.

        One after the other: a starting test waits for at most one estimate.
        """
        async with self._outlook_lock:
            if self._last[0] != wanted:
                if self.is_watching:
                    detail = "What a test can reach is computed once the one that runs has ended."
                    raise ApiError(409, "rig-busy", "Another test is running", detail)
                self._last = wanted, await self.adviser.submit("adaptive_outlook", **wanted).result
            return self._last[1]

    def _models(self, participant: str, place: Place) -> list[str]:
        """The participant's approved models, oldest first.

        Without those that are damaged, and those of tests at another place: they say nothing of this one.
        """
        rows = self.versions.all_approved_ones(participant)
        of_rows = self.versions.store.all(Test, Test.recording_id.in_([row.recording_id for row in rows]))
        elsewhere = {test.recording_id for test in of_rows if differ(place_of(test), place)}
        texts = []
        for row in [row for row in rows if row.recording_id not in elsewhere][-MOST_MODELS:]:
            with contextlib.suppress(ApiError):
                texts.append(stored_model.text(row))
        return texts

    def begin(self, planned: Planned) -> str:
        follower = Follower(planned, self, self.adviser)
        self.watch(follower)
        return follower.key

    async def close(self) -> None:
        await super().close()
        await self.adviser.close()

    def ended(self, row: Test, event: FinishedEvent, by: str) -> str:
        """As `Watched`. Where another piece of the fixed plan would have been too long, the time has ended it."""
        if by == "limit" and row.plan["adaptive"]["max_duration_s"] - event.summary["duration_s"] < PIECE_S:
            return "time"
        return {"torque_time": "torque-time", "plan": "fixed-rest"}.get(by, by)

    def fit_options(self, row: Test) -> dict[str, Any]:
        """A short recording needs to know what a curve looks like, or looked like last time.

        One that holds the whole default test needs no such help: its fixed plan was played, and was not cut off by a
        bound.
        """
        ended = (row.summary.get("adaptive") or {}).get("ended")
        if ended == "fixed-rest" and HELD_OUT in [segment["name"] for segment in row.plan["preview"]["segments"]]:
            return {}
        return {"recruitment": "near-sigmoid", "models": self._models(row.participant, place_of(row))}

    def document(self, row: Test) -> dict[str, Any]:
        plan = row.plan
        bounds = {
            "max_duration_s": plan["adaptive"]["max_duration_s"],
            "max_torque_time_nm_s": plan["adaptive"]["max_torque_time_nms"],
        }
        return {"target": plan["target"], "reach": plan["reach"], **bounds, **super().document(row)}


def fixed_plan(
    opening_us: Sequence[float], default: dict[str, Any], rate_hz: float, bounds: AdaptivePlan
) -> list[SegmentPlan]:
    """The opening, then the default test in short pieces, as many as the bounds leave room for.

    `opening_us`: the opening's widths, one for each pulse, µs; `default`: the rig's preview of the default test. Raises
    ApiError: 422: there is no room for the opening.
    """
    pieces = [("opening", [*opening_us, *[0.0] * round(TAIL_S * rate_hz)]), *_pieces(default, rate_hz)]
    room = round((bounds.max_duration_s - SAFE_END_S) * rate_hz)
    segments = []
    for name, widths in pieces:
        room -= len(widths)
        if room < 0:
            break
        settings = {"pulse_width_us": widths, "jumps": True}
        segments.append(SegmentPlan(name=name, sequence="widths", settings=settings))
    if not opening_us or not segments:
        allowed = f"{bounds.max_duration_s:g} s and {bounds.max_torque_time_nms:g} N·m·s"
        words = f"A test of at most {allowed} has no room for a first look at the muscle."
        raise out_of_reach(f"{words} Nothing was started. Allow more.")
    return segments


def _pieces(default: dict[str, Any], rate_hz: float) -> Iterator[tuple[str, list[float]]]:
    """Name and widths of each piece, the rest at the start left out: the opening ends with one."""
    widths, piece = default["pulse_width_us"], round(PIECE_S * rate_hz)
    for number, segment in enumerate(default["segments"]):
        first, end = round(segment["start_s"] * rate_hz), round(segment["end_s"] * rate_hz)
        if number or any(widths[first:end]):
            for start in range(first, end, piece):
                yield segment["name"], widths[start : min(start + piece, end)]


def out_of_reach(detail: str, **more: Any) -> ApiError:
    """422: said before the first pulse, with what can be reached."""
    return ApiError(422, "out-of-reach", "The target cannot be reached", detail, **more)
