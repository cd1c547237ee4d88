"""The angle sensor's calibration by two poses, and what the rig tells of the angle."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig import journal
from stimrig.rig.control import angle_calibration
from stimrig.rig.control.angle_calibration import Joint
from stimrig.rig.control.calibration import check_range
from stimrig.rig.devices import can_angle_sensor
from stimrig.rig.errors import BusyError, DeviceError, LatchChangedError, PlanError, RefusedError, RigError
from stimrig.rig.journal import Kind
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.messages import AngleCalibration, AnglePlan, Profile, Status
from stimrig.rig.requests import AnglePoseRequest
from tests.rig.fakes import FakeSensor, rest
from tests.rig.live import SPEED, LiveRig

BOUND = HARD_LIMITS["angle_rad"]
SETTINGS = can_angle_sensor.Settings(device="can_angle_sensor")


class AngledRig(LiveRig):
    """With an angle sensor that is held at `degrees`, or moves from there."""

    degrees, moving_deg_s = 60.0, 0.0

    def devices(self) -> dict[str, Any]:
        at = lambda t: math.radians(self.degrees + self.moving_deg_s * (t - 1000.0))  # noqa: E731
        self.sensor = FakeSensor(self.machine, at)
        return {**super().devices(), "angle_sensor": self.sensor}

    @property
    def joint(self) -> Joint:
        return self.rig.joint

    def hold(self, degrees: float) -> None:
        """For as long as a pose asks for."""
        self.degrees = degrees
        self.machine.wait(1.1 * angle_calibration.POSE_S * SPEED)

    def pose(self, told_deg: float, first: bool = False) -> Status:
        request = AnglePoseRequest(angle_rad=math.radians(told_deg), by="nurse", first=first)
        return self.ask(self.rig.angle_pose(request))

    def take(self, degrees: float, told_deg: float | None = None, first: bool = False) -> bool:
        """Hold, and pose; whether that was the second pose."""
        self.hold(degrees)
        before = self.joint.calibration
        self.pose(degrees if told_deg is None else told_deg, first)
        return self.joint.calibration is not before

    def calibrate(self) -> AngleCalibration:
        assert not self.take(20.0) and self.take(90.0)
        assert self.joint.calibration is not None
        return self.joint.calibration

    def shown_deg(self, raw: float) -> float:
        """The angle that a value of the sensor stands for now."""
        assert self.rig.pair.angle is not None
        return math.degrees(self.rig.pair.angle.scale.angle_rad(raw))


Angled = Callable[..., AngledRig]


@pytest.fixture
def angled(make: Callable[..., Any]) -> Angled:
    return lambda **changes: make(AngledRig, **{"angle_sensor": SETTINGS, **changes})


@pytest.fixture
def posed(angled: Angled) -> AngledRig:
    return angled()


def kept(posed: AngledRig, angled: Angled, settings: can_angle_sensor.Settings | None = SETTINGS) -> Any:
    """The calibration that the next process has."""
    posed.close()
    again = angled(angle_sensor=settings)
    again.close()
    return again.joint.calibration


def test_two_poses_give_offset_direction_and_scale_kept_for_this_sensor_alone(posed: AngledRig, angled: Angled):
    assert posed.take(20.0) is False
    assert posed.joint.first is not None and posed.joint.calibration is None
    assert posed.take(90.0) is True
    found = posed.joint.calibration
    assert found is not None and found.direction == -1 and found.by == "nurse" and len(found.poses) == 2
    assert found.offset == pytest.approx(30.0, abs=0.05)
    assert found.radians_per_unit == pytest.approx(math.pi / 180, rel=1e-3)
    assert posed.joint.first is None and posed.shown_deg(30.0 - 57.0) == pytest.approx(57.0, abs=0.1)
    assert kept(posed, angled) == found
    assert kept(posed, angled, SETTINGS.model_copy(update={"signal": "Other_deg"})) is None
    assert kept(posed, angled, None) is None


@pytest.mark.parametrize(
    "change",
    [
        {"offset": math.nan},
        {"offset": 31.0},
        {"radians_per_unit": math.nan},
        {"radians_per_unit": 1.1 * math.pi / 180},
        {"direction": 1},
        {"poses": []},
        {"poses": [{"angle_rad": 0.4, "raw": 10.0}] * 2},
        {"poses": [{"angle_rad": 0.4, "raw": math.nan}, {"angle_rad": 1.6, "raw": 80.0}]},
        {"poses": [{"angle_rad": 0.4, "raw": math.inf}, {"angle_rad": 1.6, "raw": 80.0}]},
        {"poses": [{"angle_rad": 0.4, "raw": -1e308}, {"angle_rad": 1.6, "raw": 1e308}]},
    ],
)
def test_a_file_that_says_something_else_than_its_poses_is_no_calibration(
    posed: AngledRig, angled: Angled, tmp_path: Path, change: dict[str, Any]
):
    found = posed.calibrate()
    assert kept(posed, angled) == found
    path = tmp_path / "angle-calibration.json"
    content = json.loads(path.read_text())
    content["calibration"] |= change
    path.write_text(json.dumps(content))
    assert kept(posed, angled) is None


@pytest.mark.parametrize(
    "content", ["[" * 100_000, '{"sensor": 1', "[]", "", "\udcff", '{"sensor":' + 5_000 * "9" + "}"]
)
def test_a_rig_comes_up_whatever_stands_in_the_file(angled: Angled, tmp_path: Path, content: str):
    (tmp_path / "angle-calibration.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert angled().joint.calibration is None


def test_a_new_first_pose_begins_again_and_the_old_calibration_holds_until_the_second(posed: AngledRig):
    old = posed.calibrate()
    assert posed.take(40.0, told_deg=45.0) is False and posed.joint.calibration is old
    assert posed.take(100.0, told_deg=105.0) is True and posed.joint.calibration is not old
    assert posed.shown_deg(30.0 - 40.0) == pytest.approx(45.0, abs=0.1)


def test_a_first_pose_of_long_ago_is_none(posed: AngledRig, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(angle_calibration, "FIRST_LASTS_S", 3.0)
    posed.take(20.0)
    posed.machine.wait(2.0 * SPEED)
    assert posed.joint.first is not None
    posed.machine.wait(1.1 * SPEED)
    assert posed.joint.first is None
    assert posed.take(75.0, told_deg=90.0) is False, "the sensor sits elsewhere meanwhile"
    assert posed.take(5.0, told_deg=20.0) is True
    assert posed.joint.calibration is not None
    assert [pose.angle_rad for pose in posed.joint.calibration.poses] == [math.radians(90.0), math.radians(20.0)]


def test_a_wrong_first_pose_is_taken_once_more(posed: AngledRig):
    posed.take(20.0, told_deg=25.0)
    assert posed.take(90.0, first=True) is False
    assert posed.joint.first is not None and posed.joint.first.angle_rad == pytest.approx(math.radians(90.0))
    assert posed.take(20.0) is True
    assert posed.joint.calibration is not None and posed.joint.calibration.offset == pytest.approx(30.0, abs=0.05)


def test_a_pose_of_a_joint_that_moved_is_refused(posed: AngledRig):
    posed.moving_deg_s = 0.75
    with pytest.raises(RefusedError, match=r"the joint moved by 1\.\d° during the last 0.5 s"):
        posed.take(20.0)
    posed.moving_deg_s = 0.0
    assert posed.take(20.0) is False


def test_poses_that_are_too_near_are_refused_and_the_first_one_stays(posed: AngledRig):
    posed.take(20.0)
    with pytest.raises(RefusedError, match=r"25.0° from the first pose, at 20.0°; at least 28.6°"):
        posed.take(45.0)
    assert posed.take(60.0) is True


@pytest.mark.parametrize(
    ("second_deg", "told_deg", "words"),
    [
        (20.5, 90.0, r"the goniometer turned by 70\.0°, the sensor by 0\.5°"),
        (60.0, 159.0, r"the goniometer turned by 139\.0°, the sensor by 40\.0°"),
        (99.0, 60.0, r"the goniometer turned by 40\.0°, the sensor by 79\.0°"),
    ],
    ids=["slipped", "misread", "would halve every angle"],
)
def test_poses_that_give_another_scale_begin_again(posed: AngledRig, second_deg: float, told_deg: float, words: str):
    posed.take(20.0)
    with pytest.raises(RefusedError, match=words):
        posed.take(second_deg, told_deg)
    assert posed.joint.first is None and posed.joint.calibration is None


@pytest.mark.parametrize("told_rad", [math.nan, math.inf, -1.0, 3.0])
def test_no_angle_of_an_elbow_is_no_pose(posed: AngledRig, told_rad: float):
    posed.hold(20.0)
    with pytest.raises(RefusedError, match="angle_pose: angle_rad"):
        posed.pose(math.degrees(told_rad))


def test_without_good_angles_there_is_no_pose(posed: AngledRig):
    with pytest.raises(DeviceError, match="too few angles"):
        posed.pose(20.0)
    for word in (1, 2, 254):
        posed.sensor.fault = word
        posed.hold(20.0)
        with pytest.raises(RefusedError, match="a fault of its own"):
            posed.pose(20.0)
    posed.sensor.fault, posed.sensor.nan = False, True
    posed.hold(20.0)
    with pytest.raises(RefusedError, match="no number"):
        posed.pose(20.0)


def test_what_cannot_be_stored_does_not_hold(posed: AngledRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    posed.take(20.0)
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(posed.joint._file, "path", tmp_path / "file" / "x.json")
    with pytest.raises(RigError):
        posed.take(90.0)
    assert posed.joint.calibration is None


HELD = {"kind": "held", "angle": AnglePlan(range_rad=(0.2, 2.0), target_rad=math.radians(60))}


def test_poses_are_told_kept_and_stand_in_the_journal(angled: Angled, tmp_path: Path):
    live = angled()
    live.machine.wait(0.2)
    told = live.rig.status().angle
    assert told.present and not told.calibrated and told.range_rad == (BOUND.lo, BOUND.hi)
    assert told.angle_rad == pytest.approx(math.radians(60), abs=0.01) and abs(told.velocity_rad_s or 9) < 0.05
    live.hold(20.0)
    status = live.pose(25.0)
    assert status.angle.pose is not None and not status.angle.calibrated
    live.hold(90.0)
    status = live.pose(95.0)
    assert status.angle.calibrated and status.angle.pose is None and status.angle.calibration is not None
    live.machine.wait(0.1)
    assert live.rig.status().angle.angle_rad == pytest.approx(math.radians(95), abs=0.01)
    live.hold(55.0)
    live.start(live.plan("t", **HELD))
    with pytest.raises(BusyError, match="test t is"):
        live.pose(60.0)
    header = journal.read(tmp_path / "journals" / "t.journal").first_json(Kind.HEADER)
    assert header is not None and header["angle"]["calibration"]["by"] == "nurse" and header["angle"]["one_bus"] is True
    live.wait("ready")
    finished = live.finished
    assert finished.outcome == "completed", finished
    assert finished.summary["angle"]["range_rad"] == pytest.approx([math.radians(60)] * 2, abs=0.02)
    event = live.event()
    assert event is not None and event.angle_rad == pytest.approx(math.radians(60), abs=0.02)
    assert [row[1] for row in event.angle_rows()][-1] == event.angle_rad
    live.sensor.gone = True
    live.machine.wait(0.1)
    assert live.rig.status().angle.problem != ""
    assert live.rig.status().state == "ready"  # a rig whose angle sensor is gone plays what needs no angle
    live.machine.wait(10.0)  # it rests
    with pytest.raises(DeviceError, match=r"the bus was lost|no adapter"):
        live.start(live.plan("u", **HELD))
    live.play("plain")
    finished = live.finished
    assert finished.outcome == "completed"
    assert any(line.startswith("angle sensor") for line in finished.summary["warnings"])


def lose_the_cell(live: AngledRig) -> object:
    live.cell.gone = True
    live.machine.wait(0.1)
    live.cell.gone = False
    return None


LATCHES: dict[str, Callable[[AngledRig], object]] = {
    "a stop": lambda live: live.stop("pressed"),
    "a fault": lambda live: live.rig.fault("stimulator: electrode error"),
    "a lost device": lose_the_cell,
}


@pytest.mark.parametrize("how", LATCHES)
def test_a_start_that_waits_while_the_rig_is_stopped_is_not_played_once_rearmed(angled: Angled, how: str):
    """It waits for an angle; who asked for it has not seen why the rig was stopped meanwhile."""
    live = angled()
    live.sensor.gone = True
    live.machine.wait(2.0)  # all angles are old
    starting = live.begin(live.rig.start(live.plan("t", **HELD)))
    live.machine.wait(0.4)
    assert not starting.done.is_set()
    asked_s = live.clock.now_s()
    LATCHES[how](live)
    assert live.clock.now_s() - asked_s <= 0.1 + 1e-6, "it does not wait behind the start"
    assert live.rig.status().state == ("disconnected" if how == "a lost device" else "latched")
    live.machine.wait(0.8)
    assert live.rearm().state == "ready"
    live.sensor.gone = False
    live.until(starting.done.is_set)
    assert isinstance(starting.error, LatchChangedError)
    live.machine.wait(8.0)
    assert live.stimulator.sent == []


def test_a_clinics_rig_needs_a_calibration_for_an_angle(angled: Angled):
    live = angled(require_calibration=True)
    plan = live.plan("p", kind="passive", angle=AnglePlan(range_rad=(0.2, 2.0)), segments=[rest(0.5)])
    with pytest.raises(RefusedError, match=r"the angle sensor is not calibrated; take two poses .* 28\.6°"):
        live.start(plan)
    live.calibrate()
    live.hold(60.0)
    live.start(plan)  # without a pulse it needs no widths that were found today
    live.wait("ready")
    assert live.finished.outcome == "completed"
    assert live.stimulator.sent == []
    with pytest.raises(RefusedError, match="not calibrated; a test needs a calibration made on the same day"):
        live.start(live.plan("h", **HELD))


def test_without_a_sensor_poses_and_angles_are_refused(live: LiveRig):
    assert live.rig.status().angle.present is False
    with pytest.raises(PlanError, match="angle_pose: this rig has no angle sensor"):
        live.ask(live.rig.angle_pose(AnglePoseRequest(angle_rad=1.0, by="nurse")))
    with pytest.raises(PlanError, match=r"plan.angle: this rig has no angle sensor"):
        live.start(live.plan("t", **HELD))


def test_a_range_that_was_said_under_another_calibration_is_refused(angled: Angled):
    live = angled()
    said = Profile(angle_range_rad=(0.2, 2.2))
    live.machine.wait(0.2)
    live.start(live.plan("before", profile=said, **HELD))  # no calibration then, and none now
    live.wait("ready")
    first = live.calibrate()
    live.hold(60.0)
    for wrong in (said, said.model_copy(update={"angle_set_at_utc": "2026-01-01T00:00:00Z"})):
        with pytest.raises(RefusedError, match=f"calibrated anew at {first.set_at_utc}; say the range again"):
            live.start(live.plan("one", profile=wrong, **HELD))
        with pytest.raises(RefusedError, match="say the range again"):
            live.preview(live.plan("one", profile=wrong, **HELD))
    right = said.model_copy(update={"angle_set_at_utc": first.set_at_utc})
    live.machine.wait(10.0)
    assert live.preview(live.plan("one", profile=right, **HELD)).duration_s == 3.0
    live.play("one", profile=right, **HELD)
    live.machine.wait(10.0)
    live.start(live.plan("two", profile=said))  # it asks for no angle
    live.wait("ready")
    with pytest.raises(RefusedError, match="has lost its calibration since; say the range again"):
        check_range(live.plan("three", profile=right, **HELD), None)
