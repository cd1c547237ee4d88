"""The angle sensor's calibration by two poses, and what the rig tells of the angle."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig import journal
from rig.acquire.angle_receiver import AngleReceiver
from rig.clock import MonotonicClock, VirtualClock
from rig.control import angle_calibration, pair, posing
from rig.control.angle_calibration import AngleCalibrating
from rig.control.rig import Rig
from rig.devices import can_angle_sensor
from rig.errors import BusyError, DeviceError, LatchedError, PlanError, RefusedError, RigError
from rig.journal import Kind
from rig.limits import HARD_LIMITS
from rig.messages import AnglePlan, AnglePoseRequest
from rig.signals import ANGLE_SAMPLE, AngleBlock, AngleScale
from tests.rig.angle import FakeSensor
from tests.rig.live import SPEED, LiveRig

BOUND = HARD_LIMITS["angle_rad"]
SETTINGS = can_angle_sensor.Settings(device="can_angle_sensor")


class Posed:
    """A calibration, its sensor, and a joint that a person moves."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.clock, self.degrees = folder, VirtualClock(), 20.0
        self.moving_deg_s = 0.0
        self.sensor = FakeSensor(self.clock, lambda t: math.radians(self.degrees + self.moving_deg_s * (t - 1000.0)))
        self.receiver = AngleReceiver(self.sensor, self.clock)
        self.poses = AngleCalibrating(folder, SETTINGS, self.clock)

    def hold(self, degrees: float, duration_s: float = 1.5) -> None:
        self.degrees = degrees
        self.sensor.feed(self.receiver, self.clock.now_s() + duration_s)
        self.clock.wait(self.clock.now_s() + duration_s)

    def pose(self, told_deg: float) -> bool:
        return self.poses.pose(math.radians(told_deg), "nurse", self.receiver, BOUND)


@pytest.fixture
def posed(tmp_path: Path) -> Posed:
    return Posed(tmp_path)


def test_two_poses_give_offset_direction_and_scale(posed: Posed):
    posed.hold(20.0)
    assert posed.pose(20.0) is False
    assert posed.poses.first is not None and posed.poses.calibration is None
    posed.hold(90.0)
    assert posed.pose(90.0) is True
    found = posed.poses.calibration
    assert found is not None and found.direction == -1 and found.by == "nurse" and len(found.poses) == 2
    assert found.offset == pytest.approx(30.0, abs=0.05)
    assert found.radians_per_unit == pytest.approx(math.pi / 180, rel=1e-3)
    assert posed.poses.first is None
    scale = posed.poses.scale
    assert scale is not None
    assert np.degrees(scale.angle_rad(np.array([30.0 - 57.0]))) == pytest.approx(57.0, abs=0.1)


def test_it_is_kept_for_this_sensor_alone(posed: Posed):
    for degrees in (20.0, 90.0):
        posed.hold(degrees)
        posed.pose(degrees)
    again = AngleCalibrating(posed.folder, SETTINGS, posed.clock)
    assert again.calibration == posed.poses.calibration
    other = SETTINGS.model_copy(update={"signal": "Other_deg"})
    assert AngleCalibrating(posed.folder, other, posed.clock).calibration is None
    assert AngleCalibrating(posed.folder, None, posed.clock).calibration is None
    (posed.folder / "angle-calibration.json").write_text('{"sensor": 1')
    assert AngleCalibrating(posed.folder, SETTINGS, posed.clock).calibration is None


@pytest.mark.parametrize(
    "change",
    [
        {"offset": math.nan},
        {"offset": 31.0},
        {"offset": math.inf},
        {"radians_per_unit": math.nan},
        {"radians_per_unit": 0.0},
        {"radians_per_unit": -math.pi / 180},
        {"radians_per_unit": 1.1 * math.pi / 180},
        {"radians_per_unit": 1e300},
        {"direction": 1},
        {"direction": True},
        {"poses": []},
        {"poses": [{"angle_rad": 0.4, "raw": 10.0}] * 2},
        {"poses": [{"angle_rad": 0.4, "raw": math.nan}, {"angle_rad": 1.6, "raw": 80.0}]},
        {"by": 5},
        {"by": "x" * 1_000_000},
    ],
)
def test_a_file_that_says_something_else_than_its_poses_is_no_calibration(posed: Posed, change: dict[str, Any]):
    for degrees in (20.0, 90.0):
        posed.hold(degrees)
        posed.pose(degrees)
    path = posed.folder / "angle-calibration.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content))
    assert AngleCalibrating(posed.folder, SETTINGS, posed.clock).calibration == posed.poses.calibration
    content["calibration"] |= change
    path.write_text(json.dumps(content))
    assert AngleCalibrating(posed.folder, SETTINGS, posed.clock).calibration is None


@pytest.mark.parametrize(
    "content", ["[" * 100_000, '{"sensor":' * 100_000, "[]", '"x"', "", "\udcff", '{"sensor":' + 5_000 * "9" + "}"]
)
def test_a_rig_comes_up_whatever_stands_in_the_file(tmp_path: Path, content: str):
    (tmp_path / "angle-calibration.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert AngleCalibrating(tmp_path, SETTINGS, VirtualClock()).calibration is None


def test_a_new_first_pose_begins_again_and_the_old_calibration_holds_until_the_second(posed: Posed):
    for degrees in (20.0, 90.0):
        posed.hold(degrees)
        posed.pose(degrees)
    old = posed.poses.calibration
    posed.hold(40.0)
    assert posed.pose(45.0) is False and posed.poses.calibration is old
    posed.hold(100.0)
    assert posed.pose(105.0) is True and posed.poses.calibration is not old
    assert posed.poses.scale is not None
    assert np.degrees(posed.poses.scale.angle_rad(np.array([30.0 - 40.0]))) == pytest.approx(45.0, abs=0.1)


def test_a_first_pose_of_long_ago_is_none(posed: Posed):
    posed.hold(20.0)
    posed.pose(20.0)
    posed.clock.wait(posed.clock.now_s() + angle_calibration.FIRST_LASTS_S + 1.0)
    assert posed.poses.first is None
    posed.hold(75.0)  # the sensor sits elsewhere meanwhile
    assert posed.pose(90.0) is False and posed.poses.calibration is None
    posed.hold(5.0)
    assert posed.pose(20.0) is True
    assert posed.poses.calibration is not None
    assert [pose.angle_rad for pose in posed.poses.calibration.poses] == [math.radians(90.0), math.radians(20.0)]


def test_who_poses_has_a_name_and_no_book():
    assert AnglePoseRequest(angle_rad=1.0, by="n" * 200).by
    with pytest.raises(ValueError, match="at most 200"):
        AnglePoseRequest(angle_rad=1.0, by="n" * 201)


def test_a_wrong_first_pose_is_taken_once_more(posed: Posed):
    posed.hold(20.0)
    posed.pose(25.0)
    posed.hold(90.0)
    assert posed.poses.pose(math.radians(90.0), "nurse", posed.receiver, BOUND, first=True) is False
    assert posed.poses.first is not None and posed.poses.first.angle_rad == pytest.approx(math.radians(90.0))
    posed.hold(20.0)
    assert posed.pose(20.0) is True
    assert posed.poses.calibration is not None and posed.poses.calibration.offset == pytest.approx(30.0, abs=0.05)


def test_a_pose_of_a_joint_that_moved_is_refused(posed: Posed):
    posed.moving_deg_s = 3.0
    posed.hold(20.0)
    with pytest.raises(RefusedError, match=r"the joint moved by 1\.\d° during the last 0.5 s"):
        posed.pose(20.0)
    posed.moving_deg_s = 0.0
    posed.hold(20.0)
    assert posed.pose(20.0) is False


def test_poses_that_are_too_near_are_refused_and_the_first_one_stays(posed: Posed):
    posed.hold(20.0)
    posed.pose(20.0)
    posed.hold(45.0)
    with pytest.raises(RefusedError, match=r"25.0° from the first pose, at 20.0°; at least 28.6°"):
        posed.pose(45.0)
    posed.hold(60.0)
    assert posed.pose(60.0) is True


@pytest.mark.parametrize("second_deg", [20.5, 159.0])
def test_poses_that_give_another_scale_begin_again(posed: Posed, second_deg: float):
    """A goniometer misread, or a sensor that slipped on its way."""
    posed.hold(20.0)
    posed.pose(20.0)
    posed.hold(second_deg if second_deg < 100 else 60.0)
    with pytest.raises(RefusedError, match=r"the goniometer turned by (70|139)\.0°, the sensor by (0\.5|40\.0)°"):
        posed.pose(90.0 if second_deg < 100 else second_deg)
    assert posed.poses.first is None and posed.poses.calibration is None


def test_a_slip_that_would_halve_every_angle_is_refused(posed: Posed):
    """60 typed for 100."""
    posed.hold(20.0)
    posed.pose(20.0)
    posed.hold(99.0)
    with pytest.raises(RefusedError, match=r"the goniometer turned by 40\.0°, the sensor by 79\.0°"):
        posed.pose(60.0)
    assert posed.poses.calibration is None


@pytest.mark.parametrize("told_rad", [math.nan, math.inf, -1.0, 3.0])
def test_no_angle_of_an_elbow_is_no_pose(posed: Posed, told_rad: float):
    posed.hold(20.0)
    with pytest.raises(RefusedError, match="angle_pose: angle_rad"):
        posed.poses.pose(told_rad, "nurse", posed.receiver, BOUND)


def test_without_good_angles_there_is_no_pose(posed: Posed):
    with pytest.raises(DeviceError, match="too few angles"):
        posed.pose(20.0)
    posed.sensor.fault = True
    posed.hold(20.0)
    with pytest.raises(RefusedError, match="a fault of its own"):
        posed.pose(20.0)
    posed.sensor.fault, posed.sensor.nan = False, True
    posed.hold(20.0)
    with pytest.raises(RefusedError, match="no number"):
        posed.pose(20.0)


def test_what_cannot_be_stored_does_not_hold(posed: Posed, monkeypatch: pytest.MonkeyPatch):
    posed.hold(20.0)
    posed.pose(20.0)
    posed.hold(90.0)
    (posed.folder / "file").write_text("")
    monkeypatch.setattr(posed.poses, "_path", posed.folder / "file" / "x.json")
    with pytest.raises(RigError):
        posed.pose(90.0)
    assert posed.poses.calibration is None


class LiveSensor:
    """Angles of real time, from the receiver's own thread."""

    sample_rate_hz, counter_modulus = 200.0, 65536
    scale, of_the_cell, on_the_cells_bus = AngleScale(30.0, -1, math.pi / 180), False, True

    def __init__(self, clock: MonotonicClock) -> None:
        self.clock, self.degrees, self.gone = clock, 60.0, False
        self._began_s, self._count = clock.now_s(), 0
        self._rng = np.random.default_rng(0)

    def open(self) -> dict[str, Any]:
        if self.gone:
            raise DeviceError("angle sensor: no adapter")
        return {"device": "live"}

    def read(self, timeout_s: float) -> AngleBlock:
        time.sleep(min(0.004, timeout_s))
        if self.gone:
            raise DeviceError("angle sensor on x: the bus was lost: gone")
        now_s = self.clock.now_s()
        due = int((now_s - self._began_s) * 200)
        samples = np.zeros(max(0, due - self._count), ANGLE_SAMPLE)
        samples["host_time_s"], samples["stamp_s"], samples["fault"] = now_s, np.nan, 0
        samples["raw"] = 30.0 - self.degrees + 0.01 * self._rng.standard_normal(len(samples))
        samples["counter"] = (self._count + np.arange(len(samples))) % 65536
        self._count = max(due, self._count)
        return AngleBlock(samples)

    def close(self) -> None: ...


class AngledRig(LiveRig):
    """A `LiveRig` with an angle sensor, as its rig file says."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, require: bool = False) -> None:
        super().__init__(folder, monkeypatch)
        self.rig.close()
        self.sensor = LiveSensor(self.clock)
        made = {"stimulator": self.stimulator, "load_cell": self.cell, "angle_sensor": self.sensor}
        found = SimpleNamespace(find=lambda kind, _: SimpleNamespace(create=lambda _settings, _clock: made[kind]))
        monkeypatch.setattr(pair, "devices", found)
        self.config = self.config.model_copy(update={"angle_sensor": SETTINGS, "require_calibration": require})
        self.rig = Rig(self.config, self.clock, self.events.append)
        self.rig.open()
        self.until(lambda: self.rig.status().angle.angle_rad is not None)

    def until(self, true: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 10
        while not true():
            assert time.monotonic() < end_s, self.rig.status()
            time.sleep(0.005)

    def pose(self, degrees: float, told_deg: float | None = None) -> Any:
        self.sensor.degrees = degrees
        told = AnglePoseRequest(angle_rad=math.radians(degrees if told_deg is None else told_deg), by="nurse")
        self.until(lambda: self.held(30.0 - degrees))
        return self.rig.angle_pose(told)

    def held(self, raw: float) -> bool:
        """Whether the receiver saw nothing else for as long as a pose asks for."""
        receiver = self.rig._pair.angle
        found = [] if receiver is None else receiver.recent(angle_calibration.POSE_S * SPEED)["raw"]
        return len(found) > 350 and bool(np.all(np.abs(found - raw) < 0.5))


@pytest.fixture
def angled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., AngledRig]]:
    rigs: list[AngledRig] = []

    def make(**more: Any) -> AngledRig:
        rigs.append(AngledRig(tmp_path, monkeypatch, **more))
        return rigs[-1]

    yield make
    for live in rigs:
        live.rig.close()


HELD = {
    "kind": "held",
    "angle": AnglePlan(range_rad=(0.2, 2.0), target_rad=math.radians(60)),
}


@pytest.mark.wire
@pytest.mark.slow
def test_poses_are_told_kept_and_stand_in_the_journal(angled: Callable[..., AngledRig], tmp_path: Path):
    live = angled()
    told = live.rig.status().angle
    assert told.present and not told.calibrated and told.range_rad == (BOUND.lo, BOUND.hi)
    assert told.angle_rad == pytest.approx(math.radians(60), abs=0.01) and abs(told.velocity_rad_s or 9) < 0.05
    status = live.pose(20.0, told_deg=25.0)
    assert status.angle.pose is not None and not status.angle.calibrated
    status = live.pose(90.0, told_deg=95.0)
    assert status.angle.calibrated and status.angle.pose is None and status.angle.calibration is not None
    live.until(lambda: abs((live.rig.status().angle.angle_rad or 0.0) - math.radians(95)) < 0.01)
    live.sensor.degrees = 55.0
    live.until(lambda: live.held(-25.0))
    live.rig.start(live.plan("t", **HELD))
    with pytest.raises(BusyError, match="test t is"):
        live.rig.angle_pose(AnglePoseRequest(angle_rad=1.0, by="nurse"))
    header = journal.read(tmp_path / "journals" / "t.journal").first_json(Kind.HEADER)
    assert header is not None and header["angle"]["calibration"]["by"] == "nurse" and header["angle"]["one_bus"] is True
    live.wait("ready")
    finished = live.rig.finished
    assert finished is not None and finished.outcome == "completed", finished
    assert finished.summary["angle"]["range_rad"] == pytest.approx([math.radians(60)] * 2, abs=0.02)
    event = live.rig.live(samples=True)
    assert event is not None and event.angle and event.angle_rad == pytest.approx(math.radians(60), abs=0.02)
    assert all(len(row) == 3 for row in event.angle)
    plain = live.plan("plain")
    live.sensor.gone = True
    live.until(lambda: live.rig.status().angle.problem != "")
    assert live.rig.status().state == "ready"  # a rig whose angle sensor is gone plays what needs no angle
    with pytest.raises(DeviceError, match=r"the bus was lost|no adapter"):
        time.sleep(0.1)
        live.rig.start(live.plan("u", **HELD))
    live.until(lambda: _started(live, plain))
    live.wait("ready")
    finished = live.rig.finished
    assert finished is not None and finished.outcome == "completed"
    assert any(line.startswith("angle sensor") for line in finished.summary["warnings"])


@pytest.mark.wire
def test_a_stop_does_not_wait_behind_a_start_that_waits_for_an_angle(
    angled: Callable[..., AngledRig], monkeypatch: pytest.MonkeyPatch
):
    live, stopped = angled(), []

    def stop_meanwhile(*_: Any) -> None:
        presses = threading.Thread(target=lambda: stopped.append(live.rig.stop("pressed", "nurse")), daemon=True)
        presses.start()
        presses.join(10)
        assert stopped, "the stop waits for the start"

    monkeypatch.setattr(posing, "await_angle", stop_meanwhile)
    with pytest.raises(LatchedError):
        live.rig.start(live.plan("t", **HELD))
    assert live.rig.status().state == "latched"


def _started(live: AngledRig, plan: Any) -> bool:
    try:
        live.rig.start(plan)
    except RefusedError:
        return False
    return True


@pytest.mark.wire
@pytest.mark.slow
def test_a_clinics_rig_needs_a_calibration_for_an_angle(angled: Callable[..., AngledRig]):
    live = angled(require=True)
    passive = {"kind": "passive", "angle": AnglePlan(range_rad=(0.2, 2.0))}
    rest = [{"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}}]
    plan = live.plan("p", **passive, segments=None).model_copy(update={"segments": None})
    plan = plan.model_validate({**plan.model_dump(), "segments": rest})
    with pytest.raises(RefusedError, match=r"the angle sensor is not calibrated; take two poses .* 28\.6°"):
        live.rig.start(plan)
    live.pose(20.0)
    live.pose(90.0)
    live.sensor.degrees = 60.0
    live.until(lambda: live.held(-30.0))
    live.rig.start(plan)  # without a pulse it needs no widths that were found today
    live.wait("ready")
    assert live.rig.finished is not None and live.rig.finished.outcome == "completed"
    assert live.stimulator.sent == []
    with pytest.raises(RefusedError, match="not calibrated; a test needs a calibration made on the same day"):
        live.rig.start(live.plan("h", **HELD))


@pytest.mark.wire
def test_without_a_sensor_poses_and_angles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    live = LiveRig(tmp_path, monkeypatch)
    assert live.rig.status().angle.present is False
    with pytest.raises(PlanError, match="angle_pose: this rig has no angle sensor"):
        live.rig.angle_pose(AnglePoseRequest(angle_rad=1.0, by="nurse"))
    with pytest.raises(PlanError, match=r"plan.angle: this rig has no angle sensor"):
        live.rig.start(live.plan("t", **HELD))
    live.rig.close()


def test_stillness_is_what_a_person_can_hold():
    assert math.degrees(angle_calibration.STILL_RAD) < 0.6
