"""The guided tests of a joint that moves: their plans, who watches them, what became of them, what is still open."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from stimrig.api.errors import ApiError
from stimrig.api.sessions import joint_plan, profiles
from stimrig.api.sessions.joint_plan import HELD, KINDS, MOVING, PASSIVE, Coverage, Layout
from stimrig.api.sessions.kinds import AT_STOPPING_TORQUE_S, SERVICE, Planned, Watched, Watcher, begun
from stimrig.api.sessions.requests import AngleIn, TestIn
from stimrig.api.store.tables import Test
from stimrig.rig import messages, requests

SAME_ANGLE_RAD = math.radians(2.5)
"""A held test was at an angle that is listed where it is as near as this: half of the steps of the list."""
SETTLED_S = 0.5
"""After stimulation has begun: then the torque is that of the level."""
NEXT_PULSES = 1.5
"""Periods after the newest pulse for which the muscle is taken to be stimulated."""
TELL_S = 0.2
"""Pages hear this often how much was seen."""


class JointTests(Watched):
    """All of them."""

    names, part, fitted = KINDS, "joint", False
    ends: ClassVar[Mapping[str, str]] = {"torque_time": "torque-time", "plan": "time", "limit": "time"}

    # ---- before ----------------------------------------------------------------------------------------------

    async def planned(self, body: TestIn, plan: messages.TestPlan, preview_s: float) -> Planned:
        """The plan of a guided test.

        Raises ApiError: 409 the rig has no angle sensor, or no angle is left to hold; 422 the participant has no range
        of angles, or one that is too small, or the target is not in it; what the rig refuses.
        """
        range_rad = self.range_of(plan)
        angle_in, longest_s = body.angle or AngleIn(), body.max_duration_s
        shared = await self._layout(plan, range_rad, longest_s, preview_s)
        angle = messages.AnglePlan(range_rad=range_rad, tolerance_rad=angle_in.tolerance_rad)
        document = {
            "kind": plan.kind, "doses": shared.doses, "known": shared.known, "longest_s": None, "target_rad": None,
            "tolerance_rad": angle_in.tolerance_rad,
        }  # fmt: skip
        if plan.kind == HELD:
            target = await asyncio.to_thread(self._target, plan, angle_in, shared)
            angle.target_rad = document["target_rad"] = target
            segments, bounds = shared.hold_segments, None
        else:
            angle.still_s = joint_plan.STILL_S[plan.kind] if angle_in.still_s is None else angle_in.still_s
            bounds = self._bounds(body, plan, shared)
            quiet_s = bounds.max_duration_s - messages.SAFE_END_S
            segments = shared.moving if plan.kind == MOVING else joint_plan.passive(quiet_s, plan.pulse_rate_hz)
            document["longest_s"] = bounds.max_duration_s
        chosen = [messages.SegmentPlan(**segment) for segment in segments]
        plan = plan.model_copy(update={"segments": chosen, "angle": angle, "adaptive": bounds})
        return Planned(plan, {"joint": document})

    async def _layout(
        self, plan: messages.TestPlan, range_rad: tuple[float, float], longest_s: float | None, preview_s: float
    ) -> Layout:
        """Lay out the three tests within the paper's torque-time."""
        paper = plan.model_copy(update={"kind": "pre-session", "segments": None})
        preview = await self.rig.ask(requests.PreviewRequest(plan=paper, recruitment=None), timeout_s=preview_s)
        table = await asyncio.to_thread(self.versions.recruitment, plan.participant)
        curve = joint_plan.curve_of(table, plan.largest_us, plan.profile.motor_pulse_width_us)
        moving_s = (joint_plan.MOVING_S if longest_s is None else longest_s) - messages.SAFE_END_S
        return joint_plan.layout(
            range_rad, curve, plan.largest_us, preview["pulse_width_us"], plan.pulse_rate_hz, moving_s
        )

    def _bounds(self, body: TestIn, plan: messages.TestPlan, shared: Layout) -> messages.AdaptivePlan:
        longest_s = {PASSIVE: joint_plan.PASSIVE_S, MOVING: joint_plan.MOVING_S}[plan.kind]
        expected = shared.doses["paper"] if shared.known else AT_STOPPING_TORQUE_S * plan.stopping_torque_nm
        largest_nm_s = body.max_torque_time_nm_s or expected
        return messages.AdaptivePlan(max_duration_s=body.max_duration_s or longest_s, max_torque_time_nms=largest_nm_s)

    def _target(self, plan: messages.TestPlan, angle_in: AngleIn, shared: Layout) -> float:
        """Return the angle to hold: the requested one, or the next that is open."""
        range_rad = plan.profile.angle_range_rad
        assert range_rad is not None
        words = profiles.range_words(range_rad)
        if angle_in.target_rad is not None:
            if not (range_rad[0] <= angle_in.target_rad <= range_rad[1]):
                detail = f"angle.target_rad {angle_in.target_rad:g} is not within the range {words}."
                raise ApiError(422, "invalid-input", "The angle is not in the participant's range", detail)
            return angle_in.target_rad
        if not shared.targets_rad:
            smallest = math.degrees(joint_plan.LEAST_RANGE_RAD)
            detail = f"The range {words} is smaller than {smallest:.0f}°. Send angle.target_rad."
            raise ApiError(422, "small-range", "The range is too small", detail)
        open_ones = [row["angle_rad"] for row in self.targets(plan.participant, shared) if not row["done"]]
        if not open_ones:
            detail = "Every angle of the list was held today. Send angle.target_rad to hold one again."
            raise ApiError(409, "all-held", "No angle is left", detail)
        return open_ones[0]

    # ---- while it plays, and after it ------------------------------------------------------------------------

    def begin(self, planned: Planned) -> str:
        """As `Kind`."""
        plan = planned.plan
        if plan.adaptive is None or plan.angle is None:
            return ""
        coverage = Coverage(plan.angle.range_rad, joint_plan.SEEN_S[plan.kind])
        self.watch(JointWatcher(plan, JointStatus(coverage), self.rig, self.clock, self.publish))
        return secrets.token_urlsafe(24)

    def end_of(self, row: Test, event: messages.FinishedEvent, rigs: str, standing: Mapping[str, Any]) -> str:  # noqa: ARG002
        """A held test has no other end than its outcome; a moving one's levels are as many as its share allows."""
        if row.kind == HELD:
            return event.outcome
        return "torque-time" if row.kind == MOVING and rigs == "plan" else ""

    def outcome(self, row: Test, event: messages.FinishedEvent) -> dict[str, Any]:
        """As `Kind`."""
        return {"joint": {**super().outcome(row, event)["joint"], "angle_rad": None, "velocity_rad_s": None}}

    def document(self, row: Test) -> dict[str, Any] | None:
        """As `Kind`."""
        return {**(super().document(row) or {}), **(row.plan.get("joint") or {}), **(row.plan.get("angle") or {})}

    def unwatched(self, row: Test) -> dict[str, Any]:
        """As `Watched`."""
        lost = begun(row) and row.kind != HELD
        why = "What is seen is not counted any more: the service was restarted during the test." if lost else ""
        state = {"state": "alone" if lost else "watching", "problem": why, "ended": ""}
        return dict.fromkeys(JointStatus.__dataclass_fields__) | state

    # ---- today's ---------------------------------------------------------------------------------------------

    def targets(self, participant: str, shared: Layout) -> list[dict[str, Any]]:
        """List the angles to hold, and which of them are done today."""
        targets = []
        rows = [row for row in self.today(participant) if row.kind == HELD]
        for target in shared.targets_rad:
            near = [row for row in rows if abs(target_of(row) - target) <= SAME_ANGLE_RAD]
            targets.append({"angle_rad": target, "done": bool(near), "test_id": near[0].id if near else None})
        return targets

    def today(self, participant: str) -> list[Test]:
        """List today's completed guided tests, newest first."""
        conditions = (
            Test.participant == participant, Test.kind.in_(KINDS), Test.state == "completed",
            Test.recording_id.is_not(None), Test.requested_utc >= self.clock.start_of_day_utc(),
        )  # fmt: skip
        return self.versions.store.all(Test, *conditions, order=Test.requested_utc.desc())

    async def overview(self, plan: messages.TestPlan, preview_s: float) -> dict[str, Any]:
        """Return today's open guided tests, and their dose relative to the paper's test.

        `plan`: any plan of the participant, with its limits.
        """
        range_rad = plan.profile.angle_range_rad
        assert range_rad is not None
        shared = await self._layout(plan, range_rad, None, preview_s)
        rows = await asyncio.to_thread(self.today, plan.participant)
        targets = await asyncio.to_thread(self.targets, plan.participant, shared)
        newest = {kind: next((row.id for row in rows if row.kind == kind), None) for kind in (PASSIVE, MOVING)}
        return {
            "range_rad": list(range_rad),
            "targets": targets,
            "next_rad": next((row["angle_rad"] for row in targets if not row["done"]), None),
            "tests": newest,
            "doses": shared.doses,
            "known": shared.known,
            "share_of_paper": shared.share,
        }


def target_of(row: Test) -> float:
    """Return the angle of a held test, rad; NaN where it has none."""
    target = (row.plan.get("angle") or {}).get("target_rad")
    return math.nan if target is None else float(target)


@dataclass
class JointStatus:
    """State of a guided test for pages and its document."""

    coverage: Coverage
    state: str = "watching"
    """watching; alone: nobody counts any more, `problem` says why; ending."""
    problem: str = ""
    ended: str = ""
    angle_rad: float | None = None
    velocity_rad_s: float | None = None
    torque_time_nm_s: float = 0.0


class JointWatcher(Watcher):
    """Counts what was seen of angle and velocity in a test in which a joint moves; ends it well when that is enough."""

    status: JointStatus
    log = logging.getLogger("stimrig.joint")

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._since_s: float | None = None
        """Since when pulses follow one another, and the newest one, on the test's clock."""
        self._last_s = 0.0
        self._shown_s = -TELL_S

    def problem(self, why: str) -> str:
        """As `Watcher`."""
        return f"What is seen is not counted any more. The test goes on to its longest time: {why}"

    def document(self) -> dict[str, Any]:
        """As `Watcher`."""
        return {**vars(self.status), "coverage": self.status.coverage.document()}

    def hear(self, event: messages.LiveEvent) -> None:
        """As `Watcher`; where the samples are enough, have the rig end the test well."""
        status = self.status
        status.torque_time_nm_s = event.torque_time_nms
        for index, width_us in zip(event.outcomes.index, event.outcomes.pulse_width_us, strict=True):
            at_s = index / event.pulse_rate_hz
            if not (width_us > 0.0):
                self._since_s = None
            else:
                self._since_s, self._last_s = at_s if self._since_s is None else self._since_s, at_s
        for host_s, angle_rad, velocity_rad_s in event.angle_rows():
            if math.isfinite(angle_rad) and math.isfinite(velocity_rad_s):
                status.angle_rad, status.velocity_rad_s = angle_rad, velocity_rad_s
                at_s = host_s - event.zero_s
                status.coverage.add(at_s, angle_rad, velocity_rad_s, self._counts(at_s))
        if status.state == "watching" and status.coverage.enough and not event.ended_by:
            status.state, status.ended = "ending", "covered"
            self.begin(self._say_enough())
        now_s = self.clock.monotonic_s()
        if now_s - self._shown_s >= TELL_S or status.state == "ending":
            self._shown_s = now_s
            self.publish()

    def _counts(self, time_s: float) -> bool:
        """Without stimulation everything counts in a passive test, and nothing in another one."""
        if self.plan.kind == PASSIVE:
            return True
        flows = time_s - self._last_s <= NEXT_PULSES / self.plan.pulse_rate_hz  # otherwise its outcome is unknown
        return flows and self._since_s is not None and time_s - self._since_s >= SETTLED_S

    async def _say_enough(self) -> None:
        try:
            await self.rig.ask(requests.EnoughRequest(test_id=self.plan.test_id, by=SERVICE, at_once=True))
        except ApiError as error:  # it has ended already, by itself or by a person
            if error.code != "rig-late":
                self.status.state, self.status.ended = "watching", ""
                raise
