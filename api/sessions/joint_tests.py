"""The guided tests of a joint that moves: their plans, who watches them, what became of them, what is still open."""

from __future__ import annotations

import asyncio
import math
import secrets
from collections.abc import Callable
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.models.registry import Versions
from stimrig.api.sessions import angles, coverage, joint_plan
from stimrig.api.sessions.adaptive_plan import Planned
from stimrig.api.sessions.joint_plan import HELD, KINDS, MOVING, PASSIVE, Layout
from stimrig.api.sessions.joint_watch import Watcher
from stimrig.api.sessions.requests import AngleIn, TestIn
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store.tables import Test
from stimrig.rig.messages import (
    SAFE_END_S,
    AdaptivePlan,
    AnglePlan,
    FinishedEvent,
    PreviewRequest,
    SegmentPlan,
    TestPlan,
)

SAME_ANGLE_RAD = math.radians(2.5)
"""A held test was at an angle that is listed where it is as near as this: half of the steps of the list."""
AT_STOPPING_TORQUE_S = 12.0
"""The largest torque-time of a moving test without a model: so many seconds at the torque that stops the test."""
ENDS = {"torque_time": "torque-time", "plan": "time", "limit": "time"}
"""Why a test ended, by the rig's reason, where it is told by another name."""


class JointTests:
    """All of them; at most one test runs.

    Parameters
    ----------
    tell : callable
        Called with a message for the live channel.
    """

    def __init__(
        self, clock: Clock, rig: RigClient, versions: Versions, tell: Callable[[dict[str, Any]], None]
    ) -> None:  # fmt: skip
        self.clock, self.rig, self.versions, self.tell = clock, rig, versions, tell
        self.watcher: Watcher | None = None
        self._task: asyncio.Task[None] | None = None

    # ---- before ----------------------------------------------------------------------------------------------

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:
        """The plan of a guided test.

        Raises
        ------
        ApiError
            409: the rig has no angle sensor, or no angle is left to hold; 422: the participant has no range of angles,
            or one that is too small, or the target is not in it; what the rig refuses.
        """
        range_rad = self._range(plan)
        asked, longest_s = body.angle or AngleIn(), body.max_duration_s
        shared = await self._layout(plan, range_rad, longest_s, preview_s)
        angle = AnglePlan(range_rad=range_rad, tolerance_rad=asked.tolerance_rad)
        told = {
            "kind": plan.kind, "doses": shared.doses, "known": shared.known, "longest_s": None, "target_rad": None,
            "tolerance_rad": asked.tolerance_rad,
        }  # fmt: skip
        if plan.kind == HELD:
            target = await asyncio.to_thread(self._target, plan, asked, shared)
            angle.target_rad = told["target_rad"] = target
            segments, bounds = shared.held, None
        else:
            angle.still_s = joint_plan.STILL_S[plan.kind] if asked.still_s is None else asked.still_s
            bounds = self._bounds(body, plan, shared)
            quiet_s = bounds.max_duration_s - SAFE_END_S
            segments = shared.moving if plan.kind == MOVING else joint_plan.passive(quiet_s, plan.pulse_rate_hz)
            told["longest_s"] = bounds.max_duration_s
        chosen = [SegmentPlan(**segment) for segment in segments]
        plan = plan.model_copy(update={"segments": chosen, "angle": angle, "adaptive": bounds})
        return Planned(plan, joint=told)

    def watched(self, plan: TestPlan, asked: AngleIn) -> TestPlan:
        """A plan of another kind that the angle may stop, too. Raises ApiError as `planned`."""
        return plan.model_copy(update={"angle": AnglePlan(range_rad=self._range(plan), still_s=asked.still_s)})

    def _range(self, plan: TestPlan) -> tuple[float, float]:
        """The participant's range of angles, where the rig can watch it."""
        self._refuse_without_sensor()
        range_rad = plan.profile.angle_range_rad
        if range_rad is None:
            detail = f"Set the angles that are comfortable for {plan.participant}: angle_range_rad of its profile."
            raise ApiError(422, "no-angle-range", "The participant has no range of angles", detail)
        return range_rad

    def _refuse_without_sensor(self) -> None:
        status = self.rig.status
        if status is not None and not status.angle.present:
            detail = "This rig has no angle sensor. The rig file names one under [angle_sensor]."
            raise ApiError(409, "no-angle-sensor", "There is no angle sensor", detail)

    async def _layout(
        self, plan: TestPlan, range_rad: tuple[float, float], longest_s: float | None, preview_s: float
    ) -> Layout:
        """What the three tests are, as long as the paper's torque-time allows."""
        paper = plan.model_copy(update={"kind": "pre-session", "segments": None})
        preview = await self.rig.ask(PreviewRequest(plan=paper, recruitment=None), timeout_s=preview_s)
        table = await asyncio.to_thread(self.versions.recruitment, plan.participant)
        curve = joint_plan.curve_of(table, plan.largest_us, plan.profile.motor_pulse_width_us)
        moving_s = (joint_plan.MOVING_S if longest_s is None else longest_s) - SAFE_END_S
        return joint_plan.layout(
            range_rad, curve, plan.largest_us, preview["pulse_width_us"], plan.pulse_rate_hz, moving_s
        )

    def _bounds(self, body: TestIn, plan: TestPlan, shared: Layout) -> AdaptivePlan:
        longest_s = {PASSIVE: joint_plan.PASSIVE_S, MOVING: joint_plan.MOVING_S}[plan.kind]
        expected = shared.doses["paper"] if shared.known else AT_STOPPING_TORQUE_S * plan.stopping_torque_nm
        most = body.max_torque_time_nm_s or expected
        return AdaptivePlan(max_duration_s=body.max_duration_s or longest_s, max_torque_time_nms=most)

    def _target(self, plan: TestPlan, asked: AngleIn, shared: Layout) -> float:
        """The angle to hold: the one that is asked for, or the next that is open."""
        range_rad = plan.profile.angle_range_rad
        assert range_rad is not None
        if asked.target_rad is not None:
            if not (range_rad[0] <= asked.target_rad <= range_rad[1]):
                detail = f"angle.target_rad {asked.target_rad:g} is not within the range {angles.words(range_rad)}."
                raise ApiError(422, "invalid-input", "The angle is not in the participant's range", detail)
            return asked.target_rad
        if not shared.targets_rad:
            least = math.degrees(joint_plan.LEAST_RANGE_RAD)
            detail = f"The range {angles.words(range_rad)} is smaller than {least:.0f}°. Send angle.target_rad."
            raise ApiError(422, "small-range", "The range is too small", detail)
        open_ones = [row["angle_rad"] for row in self.targets(plan.participant, shared) if not row["done"]]
        if not open_ones:
            detail = "Every angle of the list was held today. Send angle.target_rad to hold one again."
            raise ApiError(409, "all-held", "No angle is left", detail)
        return open_ones[0]

    # ---- while it plays --------------------------------------------------------------------------------------

    def begin(self, planned: Planned) -> str:
        """Watch a test that is about to start; the key with which it is started. Empty where there is nothing to."""
        plan = planned.plan
        if planned.joint is None or plan.adaptive is None or plan.angle is None:
            return ""
        self.leave()
        cells = coverage.grid(plan.angle.range_rad, joint_plan.SEEN_S[plan.kind])
        self.watcher = watcher = Watcher(plan, coverage.Coverage(cells), self.rig, self.clock, self._tell)
        self._task = asyncio.create_task(watcher.run(self.rig.path))
        return secrets.token_urlsafe(24)

    def _tell(self) -> None:
        if self.watcher is not None:
            self.tell({"type": "joint", "test_id": self.watcher.plan.test_id, **self.watcher.document()})

    def said_enough(self, test_id: str) -> None:
        """A person has ended it well."""
        if (watcher := self._of(test_id)) is not None:
            watcher.told.state, watcher.told.ended = "ending", watcher.told.ended or "enough"
            self._tell()

    def leave(self) -> None:
        """Watch no test any more."""
        if self._task is not None:
            self._task.cancel()
        self._task, self.watcher = None, None

    async def close(self) -> None:
        """Let everything go."""
        task = self._task
        self.leave()
        if task is not None:
            await asyncio.gather(task, return_exceptions=True)

    # ---- what became of it -----------------------------------------------------------------------------------

    def _of(self, test_id: str) -> Watcher | None:
        return self.watcher if self.watcher is not None and self.watcher.plan.test_id == test_id else None

    def outcome(self, row: Test, event: FinishedEvent) -> dict[str, Any]:
        """What is kept of a guided test, by the name it has in the summary; nothing of another one."""
        if row.kind not in KINDS:
            return {}
        rigs, watcher = str(event.summary.get("ended_by") or event.outcome), self._of(row.id)
        told = watcher.document() if watcher is not None else unwatched(row)
        ended = told["ended"] if rigs == "enough" and told["ended"] else ENDS.get(rigs, rigs)
        if row.kind == HELD:
            ended = event.outcome
        elif row.kind == MOVING and rigs == "plan":
            ended = "torque-time"  # its levels were played: they are as many as its share allows
        measured = event.summary.get("torque_time_nms", told["torque_time_nm_s"])
        told |= {"state": "ended", "ended": ended, "torque_time_nm_s": measured}
        return {"joint": {**told, "angle_rad": None, "velocity_rad_s": None}}

    def document(self, row: Test) -> dict[str, Any] | None:
        """How a guided test stands or what became of it; None of a test of another kind."""
        if row.kind not in KINDS:
            return None
        watcher, angle = self._of(row.id), row.plan.get("angle") or {}
        told = row.summary.get("joint") or (watcher.document() if watcher is not None else unwatched(row))
        return {**told, **(row.plan.get("joint") or {}), **angle}

    def targets(self, participant: str, shared: Layout) -> list[dict[str, Any]]:
        """The angles to hold, and which of them were held today."""
        found = []
        rows = [row for row in self.today(participant) if row.kind == HELD]
        for target in shared.targets_rad:
            near = [row for row in rows if abs(target_of(row) - target) <= SAME_ANGLE_RAD]
            found.append({"angle_rad": target, "done": bool(near), "test_id": near[0].id if near else None})
        return found

    def today(self, participant: str) -> list[Test]:
        """Guided tests of today that ended well, newest first."""
        conditions = (
            Test.participant == participant, Test.kind.in_(KINDS), Test.state == "completed",
            Test.recording_id.is_not(None), Test.requested_utc >= self.clock.start_of_day_utc(),
        )  # fmt: skip
        return self.versions.store.all(Test, *conditions, order=Test.requested_utc.desc())

    async def overview(self, plan: TestPlan, preview_s: float) -> dict[str, Any]:
        """What is open of today's guided tests, and what they cost beside the paper's test.

        Parameters
        ----------
        plan : TestPlan
            Any plan of the participant, with its limits.
        """
        range_rad = plan.profile.angle_range_rad
        assert range_rad is not None
        shared = await self._layout(plan, range_rad, None, preview_s)
        rows = await asyncio.to_thread(self.today, plan.participant)
        held = await asyncio.to_thread(self.targets, plan.participant, shared)
        newest = {kind: next((row.id for row in rows if row.kind == kind), None) for kind in (PASSIVE, MOVING)}
        return {
            "range_rad": list(range_rad),
            "targets": held,
            "next_rad": next((row["angle_rad"] for row in held if not row["done"]), None),
            "tests": newest,
            "doses": shared.doses,
            "known": shared.known,
            "share_of_paper": shared.share,
        }


def target_of(row: Test) -> float:
    """The angle of a held test, rad; NaN where it has none."""
    target = (row.plan.get("angle") or {}).get("target_rad")
    return math.nan if target is None else float(target)


def unwatched(row: Test) -> dict[str, Any]:
    """Of a test that this service does not watch: a held one, one that never began, or it was restarted meanwhile."""
    begun = row.state not in ("requested", "refused") and row.kind != HELD
    why = "What is seen is not counted any more: the service was restarted during the test." if begun else ""
    return {
        "state": "alone" if begun else "watching", "problem": why, "ended": "", "angle_rad": None,
        "velocity_rad_s": None, "torque_time_nm_s": None, "coverage": None,
    }  # fmt: skip
