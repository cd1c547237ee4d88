"""The joint's angle: its calibration by two poses, and whether a test may use it."""

from __future__ import annotations

from rig.acquire.angle_check import degrees
from rig.acquire.angle_guard import await_angle, check_start
from rig.control.angle_calibration import APART_RAD
from rig.control.extending import Extending
from rig.errors import BusyError, PlanError, RefusedError
from rig.limits import Limit
from rig.messages import AnglePoseRequest, StateEvent, Status, TestPlan

NO_SENSOR = "{}: this rig has no angle sensor; name one in its rig file (docs/rig-file.md)"


class Posing(Extending):
    """Takes poses. Nothing is sent to a device meanwhile."""

    @property
    def angle_set_at_utc(self) -> str | None:
        """When the angle sensor was calibrated; None: it was not. May be called from another thread."""
        found = self._poses.calibration
        return None if found is None else found.set_at_utc

    async def angle_pose(self, request: AnglePoseRequest) -> Status:
        """The goniometer's angle of a joint that is held still; the second one completes a calibration.

        Raises
        ------
        PlanError
            This rig has no angle sensor.
        BusyError
            A test is in progress.
        DeviceError, RefusedError, RigError
            See `AngleCalibrating.pose`.
        """
        async with self._in_turn():
            if not self._has_angle:
                raise PlanError(NO_SENSOR.format("angle_pose"))
            if self._trial.busy:
                raise BusyError(f"test {self._trial.test_id} is {self._trial.state}; take the pose afterwards")
            await self._poses.pose(
                request.angle_rad, request.by, self._angle_receiver(), self._table["angle_rad"], request.first
            )
            self._pair.rescale(self._poses.scale)
            self._publish(StateEvent(status=self.status()))
        return self.status()

    async def _await_angle(self, plan: TestPlan) -> None:
        """Wait for a first angle, where a test asks for one."""
        receiver = self._angle_receiver() if plan.angle is not None and self._has_angle else None
        if receiver is not None:
            await await_angle(receiver, self._tasks)

    def _check_angle(self, plan: TestPlan, table: dict[str, Limit]) -> None:
        """Refuse a test that asks for an angle that this rig cannot give, or where the joint is elsewhere."""
        if plan.angle is None:
            return
        if not self._has_angle:
            raise PlanError(NO_SENSOR.format("plan.angle"))
        if self._require_calibration and self._poses.calibration is None:
            raise RefusedError(
                "plan.angle: the angle sensor is not calibrated; take two poses with a goniometer, "
                f"{degrees(APART_RAD)} or more apart"
            )
        check_start(self._angle_receiver(), plan, table, self._clock)
