"""The joint's angle, and the calibration of its sensor by two poses: what a goniometer shows, and what it gives there.

The calibration is kept in the data folder, for the sensor that it was made with. Another one in the rig file has none.
"""

from __future__ import annotations

import logging
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.angle_guard import await_angle, check_start, degrees
from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.clock import utc_text
from stimrig.rig.config import RigConfig
from stimrig.rig.control.live import finite
from stimrig.rig.control.memory import SmallFile
from stimrig.rig.control.pair import Pair
from stimrig.rig.errors import BusyError, DeviceError, PlanError, RefusedError
from stimrig.rig.limits import Limit, refuse
from stimrig.rig.machine import Machine
from stimrig.rig.messages import AngleCalibration, AnglePose, AngleStatus, TestPlan
from stimrig.rig.phase import Phase
from stimrig.rig.requests import AnglePoseRequest
from stimrig.rig.signals import TRUSTED, AngleScale

log = logging.getLogger("rig")

POSE_S = 0.5
"""Real seconds for which the joint must have been still when a pose is told."""
STILL_RAD = 0.01
PART_S = 0.05
"""Real seconds of which one mean counts for stillness: noise is no movement."""
LEAST_SHARE = 0.7
"""Share of the samples due in that time that must have come."""
APART_RAD = 0.5
FIRST_LASTS_S = 600.0
"""Real seconds for which a first pose waits for its second: later the sensor may sit elsewhere."""
SCALES = 0.7, 1.4
"""Bounds of the scale of two poses over the rig file's: beyond them a number was mistyped or the sensor slips."""
SENSOR = "device", "bus", "dbc", "message", "signal", "of_the_cell"
"""Settings that tell one sensor from another."""


class Joint:
    """The joint's angle as the rig's sensor gives it, the sensor's calibration, and the first pose of the next one."""

    def __init__(self, config: RigConfig, machine: Machine, pair: Pair, bound: Limit) -> None:
        self._file = SmallFile(config.data_dir / "angle-calibration.json", "angle_pose", machine)
        self._present, self._needs_calibration = config.angle_sensor is not None, config.require_calibration
        content = {} if config.angle_sensor is None else config.angle_sensor.model_dump(mode="json")
        self._sensor = {name: content[name] for name in SENSOR if name in content}
        self._pair, self._bound, self._tasks, self._clock = pair, bound, machine.tasks, machine.tasks.clock
        self._first: tuple[AnglePose, float] | None = None
        self.calibration: AngleCalibration | None = None

    async def recall(self) -> None:
        """Read the calibration that was kept, if it is this sensor's."""
        try:
            content = await self._file.read() if self._present else None
            if content is None:
                return
            if content["sensor"] == self._sensor:
                self.calibration = _check_poses(AngleCalibration.model_validate(content["calibration"]))
                self._rescale()
            else:
                log.warning("%s: made with another sensor; take two poses again", self._file.path)
        except (OSError, ValueError, KeyError, ArithmeticError) as error:
            log.error("%s: not readable (%s); take two poses again", self._file.path, " ".join(str(error).split()))

    def _rescale(self) -> None:
        if (found := self.calibration) is not None:
            self._pair.rescale(AngleScale(found.offset, found.direction, found.radians_per_unit))

    @property
    def first(self) -> AnglePose | None:
        """The first pose of the next calibration, while it waits for its second."""
        if self._first is None:
            return None
        pose, told_s = self._first
        return pose if self._clock.now_s() - told_s <= FIRST_LASTS_S * self._clock.speed else None

    @property
    def set_at_utc(self) -> str | None:
        """When the sensor was calibrated; None: it was not."""
        calibration = self.calibration
        return None if calibration is None else calibration.set_at_utc

    def status(self) -> AngleStatus:
        if not self._present:
            return AngleStatus()
        angle = self._pair.angle
        now: dict[str, Any] = {}
        if angle is not None:
            age_s = angle.age_s(self._clock.now_s())
            status = {"angle_rad": angle.angle_rad, "velocity_rad_s": angle.velocity_rad_s, "age_s": age_s}
            now = {"problem": angle.problem, **{name: finite(value) for name, value in status.items()}}
        return AngleStatus(
            present=True,
            calibrated=self.calibration is not None,
            range_rad=(self._bound.lo, self._bound.hi),
            pose=self.first,
            calibration=self.calibration,
            **now,
        )

    def described(self) -> dict[str, Any] | None:
        """Return the entry of the sensor in a journal's header, with its scale; None: there is no sensor."""
        if self._pair.angle is None:
            return None
        sensor, calibration = self._pair.angle.sensor, self.calibration
        scale = {"poses": [], **asdict(sensor.scale), "by": "rig file", "set_at_utc": ""}
        return {
            "sample_rate_hz": sensor.sample_rate_hz,
            "of_the_cell": sensor.of_the_cell,
            "one_bus": sensor.on_the_cells_bus,
            "calibration": scale if calibration is None else calibration.model_dump(mode="json"),
        }

    async def await_angle(self, plan: TestPlan) -> None:
        """Wait a moment for the first angle, if a test asks for it. Raises DeviceError: the rig is disconnected."""
        if plan.angle is not None and self._present:
            await await_angle(self._receiver(), self._tasks)

    def check(self, plan: TestPlan, table: dict[str, Limit]) -> None:
        """Refuse a test that asks for an angle that this rig cannot give, or where the joint is elsewhere.

        Raises PlanError, RefusedError, DeviceError.
        """
        if plan.angle is None:
            return
        self._refuse_absent("plan.angle")
        if self._needs_calibration and self.calibration is None:
            raise RefusedError(
                "plan.angle: the angle sensor is not calibrated; take two poses with a goniometer, "
                f"{degrees(APART_RAD)} or more apart"
            )
        check_start(self._receiver(), plan, table, self._clock)

    async def pose(self, request: AnglePoseRequest, phase: Phase) -> None:
        """Take the goniometer's angle of a joint that is held still; the second one completes a calibration.

        Raises PlanError: this rig has no angle sensor. BusyError: a test is in progress. RefusedError: no angle of a
        joint, the joint moved, or the two poses do not fit each other. DeviceError: the sensor gives no angle.
        RigError: the calibration could not be stored: the old one holds.
        """
        self._refuse_absent("angle_pose")
        if phase.busy:
            raise BusyError(f"test {phase.test_id} is {phase.state}; take the pose afterwards")
        refuse(self._bound, request.angle_rad, "angle_pose")
        receiver = self._receiver()
        pose = AnglePose(angle_rad=request.angle_rad, raw=still_raw(receiver, self._clock.speed))
        before = None if request.first else self.first
        if before is None:
            self._first = pose, self._clock.now_s()
            return
        calibration = self._of_two(before, pose, request.by, receiver.sensor.scale)
        await self._file.write({"sensor": self._sensor, "calibration": calibration.model_dump(mode="json")})
        self._first, self.calibration = None, calibration
        log.info("angle sensor calibrated: %s", calibration.model_dump_json(exclude={"by"}))
        self._rescale()

    def _of_two(self, first: AnglePose, second: AnglePose, by: str, rig_file: AngleScale) -> AngleCalibration:
        apart_rad = second.angle_rad - first.angle_rad
        if not (abs(apart_rad) >= APART_RAD):
            raise RefusedError(
                f"angle_pose: it is {degrees(abs(apart_rad))} from the first pose, at {degrees(first.angle_rad)}; at "
                f"least {degrees(APART_RAD)} are needed: move the joint farther"
            )
        scale = _scale(first, second)
        turned_rad = abs(second.raw - first.raw) * rig_file.radians_per_unit
        lo, hi = (factor * rig_file.radians_per_unit for factor in SCALES)
        if not (lo <= scale["radians_per_unit"] <= hi):
            self._first = None
            raise RefusedError(
                f"angle_pose: between the two poses the goniometer turned by {degrees(abs(apart_rad))}, the sensor by "
                f"{degrees(turned_rad)}; check goniometer and mounting, then begin with the first pose"
            )
        return AngleCalibration(poses=[first, second], **scale, by=by, set_at_utc=utc_text(self._clock.unix_s()))

    def _refuse_absent(self, place: str) -> None:
        if not self._present:
            raise PlanError(f"{place}: this rig has no angle sensor; name one in its rig file (docs/rig-file.md)")

    def _receiver(self) -> AngleReceiver:
        if self._pair.angle is None:
            raise DeviceError("angle sensor: the rig is disconnected; re-arm it first")
        return self._pair.angle


def _scale(first: AnglePose, second: AnglePose) -> dict[str, Any]:
    """Offset, direction and scale that two poses make; the scale is infinite where the signal did not change."""
    apart = second.raw - first.raw
    slope = (second.angle_rad - first.angle_rad) / apart if apart else float("inf")
    return {
        "offset": first.raw - first.angle_rad / slope,
        "direction": 1 if slope > 0 else -1,
        "radians_per_unit": abs(slope),
    }


def _check_poses(calibration: AngleCalibration) -> AngleCalibration:
    """A calibration out of its file, if it is what its two poses make: a digit that changed is noticed, too.

    Raises ValueError: it is not.
    """
    first, second = calibration.poses
    if not (abs(second.angle_rad - first.angle_rad) >= APART_RAD and second.raw != first.raw):
        raise ValueError("its poses are too near")
    if calibration.model_copy(update=_scale(first, second)) != calibration:
        raise ValueError("it is not what its two poses make")
    return calibration


def still_raw(receiver: AngleReceiver, speed: float) -> float:
    """Return the sensor's mean during the last moment, in its unit.

    Raises DeviceError: too little came. RefusedError: the joint moved, or the sensor reports a fault.
    """
    samples = receiver.recent(POSE_S * speed)
    raw = samples["raw"]
    if len(samples) < max(3.0, LEAST_SHARE * POSE_S * speed * receiver.nominal_rate_hz):
        raise DeviceError(receiver.problem or "angle sensor: too few angles arrive; check its cable and supply")
    if not (np.all(np.isfinite(raw)) and np.all(np.isin(samples["fault"], TRUSTED))):
        raise RefusedError("angle_pose: the sensor reports a fault of its own, or no number; check sensor and cable")
    moved_rad = _moved(samples, PART_S * speed) * receiver.sensor.scale.radians_per_unit
    if not (moved_rad < STILL_RAD):
        raise RefusedError(
            f"angle_pose: the joint moved by {degrees(moved_rad)} during the last {POSE_S:g} s; hold it still, read "
            "the goniometer again, then tell the pose"
        )
    return float(np.mean(raw))


def _moved(samples: NDArray[Any], part_s: float) -> float:
    """Largest difference of the means of short parts, in the sensor's unit."""
    part = np.floor((samples["host_time_s"] - samples["host_time_s"][0]) / part_s).astype(int)
    means = [float(np.mean(samples["raw"][part == each])) for each in np.unique(part)]
    return max(means) - min(means)
