"""The guided tests of a joint that moves: their plans, who watches them, what became of them, what is still open."""

from __future__ import annotations

import asyncio
import math
import secrets
from dataclasses import dataclass
from typing import Any

from stimrig.api.errors import ApiError, invalid
from stimrig.api.sessions import joint_plan, profiles
from stimrig.api.sessions.joint_plan import HELD, KINDS, MOVING, PASSIVE, Coverage, Layout
from stimrig.api.sessions.kinds import AT_STOPPING_TORQUE_S, SERVICE, Planned, Watched, Watcher, WatchStatus
from stimrig.api.sessions.requests import AngleIn, TestIn
from stimrig.api.store.tables import Test
from stimrig.rig import messages, requests

SAME_ANGLE_RAD = math.radians(2.5)
"""A held test was at an angle that is listed where it is as near as this: half of the steps of the list."""
SETTLED_S = 0.5
"""After stimulation has begun: then the torque is that of the level."""
NEXT_PULSES = 1.5
"""Periods after the newest pulse for which the muscle is taken to be stimulated."""
WIDTHS_FROM = {"profile", "protocol", "pulse_rate_hz", "max_pulse_width_us", "max_torque_nm"}
"""Fields of a plan on which the widths of the default test depend."""
TELL_S = 0.2
"""Pages hear this often how much was seen."""


@dataclass
class JointStatus(WatchStatus):
    """State of a guided test: watching; alone (nobody counts any more, `problem` says why); ending."""

    angle_rad: float | None = None
    velocity_rad_s: float | None = None
    coverage: dict[str, Any] | None = None


class JointTests(Watched):
    """All of them."""

    names, part, fitted, status_type = KINDS, "joint", False, JointStatus
    left_alone = "What is seen is not counted any more. The test goes on to its longest time"

    _default: tuple[str, list[float]] | None = None
    """The `WIDTHS_FROM` of the last plan whose default test the rig previewed, and its widths, µs."""

    # ---- before ----------------------------------------------------------------------------------------------

    async def planned(self, body: TestIn, plan: messages.TestPlan, preview_s: float) -> Planned:
        """The plan of a guided test.

        Raises ApiError: 409 the rig has no angle sensor, or no angle is left to hold; 422 the participant has no range
        of angles, or one that is too small, or the target is not in it; what the rig refuses.
        """
        angle_in, longest_s = body.angle or AngleIn(), body.max_duration_s
        angle = messages.AnglePlan(range_rad=self.range_of(plan), tolerance_rad=profiles.TOLERANCE_RAD)
        shared = await self._layout(plan, longest_s, preview_s)
        bounds, segments = None, shared.held if plan.kind == HELD else shared.moving
        if plan.kind == HELD:
            angle.target_rad = await asyncio.to_thread(self._target, plan, angle_in, shared)
        else:
            angle.still_s = angle_in.still_s or joint_plan.STILL_S[plan.kind]
            expected = shared.doses["paper"] if shared.known else AT_STOPPING_TORQUE_S * plan.stopping_torque_nm
            bounds = messages.AdaptivePlan(
                max_duration_s=longest_s or joint_plan.LONGEST_S[plan.kind],
                max_torque_time_nms=body.max_torque_time_nm_s or expected,
            )
        if plan.kind == PASSIVE and bounds is not None:
            quiet_s = bounds.max_duration_s - messages.SAFE_END_S
            segments = [joint_plan.still("passive", quiet_s, plan.pulse_rate_hz)]
        chosen = [messages.SegmentPlan(**segment) for segment in segments]
        plan = plan.model_copy(update={"segments": chosen, "angle": angle, "adaptive": bounds})
        document = {
            "kind": plan.kind, "doses": shared.doses, "known": shared.known,
            "longest_s": bounds and bounds.max_duration_s, **angle.model_dump(),
        }  # fmt: skip
        return Planned(plan, {"joint": document})

    async def _layout(self, plan: messages.TestPlan, longest_s: float | None, preview_s: float) -> Layout:
        """Lay out the three tests within the default test's torque-time; `plan`: any of the participant's."""
        default_us = await self._default_widths(plan, preview_s)
        table = await asyncio.to_thread(self.versions.recruitment, plan.participant)
        curve = joint_plan.curve_of(table, plan.largest_us, plan.profile.motor_pulse_width_us)
        moving_s = (longest_s or joint_plan.LONGEST_S[MOVING]) - messages.SAFE_END_S
        range_rad, rate_hz = plan.profile.angle_range_rad, plan.pulse_rate_hz
        assert range_rad is not None
        return joint_plan.layout(range_rad, curve, plan.largest_us, default_us, rate_hz, moving_s)

    async def _default_widths(self, plan: messages.TestPlan, preview_s: float) -> list[float]:
        """Return every width of the default test with the limits of `plan`, µs.

        The rig previews nothing while a test plays: then the last answer for the same limits is returned.

        Raises ApiError: 409 rig-busy there is none; what the rig refuses.
        """
        limits = plan.model_dump_json(include=WIDTHS_FROM)
        default = plan.model_copy(update={"kind": "pre-session", "segments": None})
        try:
            preview = await self.rig.ask(requests.PreviewRequest(plan=default, recruitment=None), timeout_s=preview_s)
        except ApiError as error:
            if error.code != "rig-busy" or self._default is None or self._default[0] != limits:
                raise
        else:
            self._default = limits, preview["pulse_width_us"]
        return self._default[1]

    def _target(self, plan: messages.TestPlan, angle_in: AngleIn, shared: Layout) -> float:
        """Return the angle to hold: the requested one, or the next that is open."""
        range_rad, target_rad = plan.profile.angle_range_rad or (0.0, 0.0), angle_in.target_rad
        words = profiles.range_words(range_rad)
        if target_rad is not None:
            if not (range_rad[0] <= target_rad <= range_rad[1]):
                raise invalid(f"angle.target_rad {target_rad:g} is not within the range {words}.")
            return target_rad
        if not shared.targets_rad:
            smallest = math.degrees(joint_plan.LEAST_RANGE_RAD)
            detail = f"The range {words} is smaller than {smallest:.0f}°. Send angle.target_rad."
            raise ApiError(422, "small-range", "The range is too small", detail)
        targets = self._targets(self._today(plan.participant), shared)
        if (next_rad := next((row["angle_rad"] for row in targets if not row["done"]), None)) is None:
            detail = "Every angle of the list was held today. Send angle.target_rad to hold one again."
            raise ApiError(409, "all-held", "No angle is left", detail)
        return next_rad

    # ---- while it plays, and after it ------------------------------------------------------------------------

    def begin(self, planned: Planned) -> str:
        if planned.plan.adaptive is None:
            return ""
        self.watch(JointWatcher(planned.plan, self))
        return secrets.token_urlsafe(24)

    def ended(self, row: Test, event: messages.FinishedEvent, by: str) -> str:
        """As `Watched`. A moving test's levels are as many as its share allows."""
        if row.kind == HELD:
            return event.outcome
        plan = "torque-time" if row.kind == MOVING else "time"
        return {"torque_time": "torque-time", "plan": plan, "limit": "time"}.get(by, by)

    def outcome(self, row: Test, event: messages.FinishedEvent) -> dict[str, Any]:
        return {"joint": {**super().outcome(row, event)["joint"], "angle_rad": None, "velocity_rad_s": None}}

    def document(self, row: Test) -> dict[str, Any]:
        return {**super().document(row), **row.plan["joint"]}

    # ---- today's ---------------------------------------------------------------------------------------------

    def _targets(self, rows: list[Test], shared: Layout) -> list[dict[str, Any]]:
        """List the angles to hold, each with the newest test of `rows` that held it."""
        targets = []
        for target in shared.targets_rad:
            near = [row.id for row in rows if row.kind == HELD and abs(target_of(row) - target) <= SAME_ANGLE_RAD]
            targets.append({"angle_rad": target, "done": bool(near), "test_id": near[0] if near else None})
        return targets

    def _today(self, participant: str) -> list[Test]:
        """List today's completed guided tests, newest first."""
        conditions = (
            Test.participant == participant, Test.kind.in_(KINDS), Test.state == "completed",
            Test.recording_id.is_not(None), Test.requested_utc >= self.clock.start_of_day_utc(),
        )  # fmt: skip
        return self.versions.store.all(Test, *conditions, order=Test.requested_utc.desc())

    async def overview(self, plan: messages.TestPlan, preview_s: float) -> dict[str, Any]:
        """Return today's open guided tests, and their dose relative to the default test.

        `plan`: any plan of the participant, with its limits.
        """
        shared = await self._layout(plan, None, preview_s)
        rows = await asyncio.to_thread(self._today, plan.participant)
        targets = self._targets(rows, shared)
        return {
            "targets": targets,
            "next_rad": next((row["angle_rad"] for row in targets if not row["done"]), None),
            "tests": {kind: next((row.id for row in rows if row.kind == kind), None) for kind in (PASSIVE, MOVING)},
            "doses": shared.doses,
            "known": shared.known,
            "share_of_paper": shared.share,
        }


def target_of(row: Test) -> float:
    """Return the angle of a held test, rad; NaN where it has none."""
    target = (row.plan.get("angle") or {}).get("target_rad")
    return math.nan if target is None else float(target)


class JointWatcher(Watcher):
    """Counts what was seen of angle and velocity in a test in which a joint moves; ends it well when that is enough."""

    status: JointStatus

    def __init__(self, plan: messages.TestPlan, kind: JointTests) -> None:
        super().__init__(plan, kind)
        assert plan.angle is not None
        self.coverage = Coverage(plan.angle.range_rad, joint_plan.SEEN_S[plan.kind])
        self._since_s: float | None = None
        """Since when pulses follow one another, and the newest one, on the test's clock."""
        self._last_s = 0.0
        self._shown_s = -TELL_S

    def document(self) -> dict[str, Any]:
        return {**vars(self.status), "coverage": self.coverage.document()}

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
                self.coverage.add(at_s, angle_rad, velocity_rad_s, self._counts(at_s))
        if status.state == self.kind.watching and self.coverage.enough and not event.ended_by:
            status.state, status.ended = "ending", "covered"
            self.begin(self._say_enough())
        now_s = self.clock.monotonic_s()
        if now_s - self._shown_s >= TELL_S or status.state == "ending":
            self._shown_s = now_s
            self.kind.publish()

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
                self.status.state, self.status.ended = self.kind.watching, ""
                raise
