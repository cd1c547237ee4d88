"""A test with an angle on the virtual clock: each fault of the sensor ends it and says why; other tests go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.rig import archive, limits
from stimrig.rig.acquire.angle_guard import check_start, outside
from stimrig.rig.control.sealing import warnings
from stimrig.rig.errors import DeviceError, PlanError, RefusedError
from stimrig.rig.messages import AdaptivePlan, AnglePlan
from stimrig.rig.signals import Pulse, PulseStatus
from tests.rig.fakes import BEGINS_S, VirtualRig, extend, hold, refusals, rest

pytestmark = pytest.mark.slow

RANGE = (math.radians(20), math.radians(120))
REST = [rest(5.0)]
HELD = AnglePlan(range_rad=RANGE, target_rad=math.radians(60))


def swinging(time_s: float) -> float:
    """60 ± 30 degrees, once in 4 s."""
    return math.radians(60 + 30 * math.sin(2 * math.pi * time_s / 4))


def held(folder: Path, **more: Any) -> VirtualRig:
    return VirtualRig(folder, **{"kind": "held", "angle": HELD, "has_sensor": True, **more})


def moving(folder: Path, still_s: float = 1.0, **more: Any) -> VirtualRig:
    rig = VirtualRig(
        folder, **{"kind": "moving", "angle": AnglePlan(range_rad=RANGE, still_s=still_s), "has_sensor": True, **more}
    )
    rig.sensor.angle_rad = swinging
    return rig


def set_to(name: str, value: Any) -> Callable[[VirtualRig], None]:
    return lambda rig: setattr(rig.sensor, name, value)


FAULTS: dict[str, tuple[Callable[[VirtualRig], None], str, float]] = {
    "silent": (set_to("silent", True), "stale", 0.16),
    "nan": (set_to("nan", True), "not a number (NaN)", 0.05),
    "fault bit": (set_to("fault", True), "a fault of its own", 0.05),
    "fault word": (set_to("fault", 2), "a fault of its own", 0.05),
    "jump": (set_to("add_deg", -15.0), "jumped by 1", 0.05),
    "counter": (set_to("skip", 5000), "counter jumped", 0.05),
    "repeated": (set_to("repeating", True), "counter went back", 0.16),
    "delayed": (set_to("late_s", 0.3), "stale", 0.16),
    "power": (lambda rig: (set_to("counter", 0)(rig), set_to("add_deg", -15.0)(rig)), "counter went back", 0.1),
    "nonsense": (set_to("add_deg", 1e300), "jumped by 1", 0.05),
}
"""What happens to the sensor, what is told, and within how many seconds no pulse follows any more."""


@pytest.mark.parametrize(
    ("make", "fault"), [*((held, fault) for fault in FAULTS), (moving, "silent"), (moving, "jump")]
)
def test_a_fault_of_the_sensor_ends_the_test_and_says_why(tmp_path: Path, make: Callable[..., VirtualRig], fault: str):
    rig = make(tmp_path)
    happens, words, within_s = FAULTS[fault]
    at_s: list[float] = []
    rig.at(1.3, lambda: (at_s.append(rig.clock.now_s()), happens(rig)))
    result = rig.execute()
    assert result.outcome == "fault"
    assert result.reason.startswith("angle sensor: ")
    assert words in result.reason
    assert rig.stimulator.sent[-1][0] <= at_s[0] + within_s
    assert rig.stimulator.stops == 1


@pytest.mark.parametrize("fault", ["silent", "nan", "jump", "repeated", "nonsense", "fault word"])
def test_a_test_without_an_angle_goes_on_records_and_warns(tmp_path: Path, fault: str):
    rig = VirtualRig(tmp_path, has_sensor=True)
    rig.at(1.3, lambda: FAULTS[fault][0](rig))
    if fault.startswith("fault "):
        rig.at(1.3, lambda: set_to("add_deg", 40.0)(rig))
    result = rig.execute()
    assert (result.outcome, result.reason) == ("completed", "")
    sealed = rig.seal()
    columns = sealed.recording.columns
    assert len(columns["angle/time_s"]) > 200
    assert all(np.isfinite(columns[path]).all() for path, _, _ in archive.ANGLE_COLUMNS)
    if fault in ("nonsense", "fault bit", "fault word"):
        assert np.all(np.abs(columns["angle/angle_rad"] - math.radians(60)) < 0.01), "what is no angle is left out"
    told = [line for line in warnings(sealed.recording) if line.startswith("angle sensor: ")]
    assert len(told) == 1 and FAULTS[fault][1] in told[0]
    assert identify.read(sealed.path).time_s[-1] > 2.4


@pytest.mark.parametrize("make", [held, moving])
def test_a_test_with_an_angle_plays_to_its_end(tmp_path: Path, make: Callable[..., VirtualRig]):
    rig = make(tmp_path)
    result = rig.execute()
    assert (result.outcome, result.reason) == ("completed", "")
    assert result.summary["angle"]["lost_samples"] == 0
    assert warnings(rig.recording()) == []


def test_a_joint_that_leaves_its_range_ends_the_test(tmp_path: Path):
    rig = moving(tmp_path, angle_range_rad=(math.radians(20), math.radians(80)))
    result = rig.execute()
    assert result.outcome == "fault"
    assert result.reason.startswith("angle sensor: 80.") and "(participant's profile)" in result.reason


@pytest.mark.parametrize(("farthest_deg", "outcome"), [(9.0, "completed"), (30.0, "fault")])
def test_a_joint_that_leaves_its_target_by_more_than_twice_its_tolerance_ends_the_test(
    tmp_path: Path, farthest_deg: float, outcome: str
):
    rig = held(tmp_path)
    rig.sensor.angle_rad = lambda t: math.radians(60 + min(farthest_deg, max(0.0, 10 * (t - 1001.0))))
    result = rig.execute()
    assert result.outcome == outcome
    assert all(words in result.reason for words in ("the joint is at 70.", "60.0° ± 10.3°")) == (outcome == "fault")


@pytest.mark.parametrize("noise_deg", [0.0, 0.02])
def test_without_a_movement_a_moving_test_ends(tmp_path: Path, noise_deg: float):
    """With more noise of the sensor a joint that stands still takes longer to be seen."""
    rig = moving(tmp_path)
    rig.sensor.noise_deg = noise_deg
    stands_s = rig.clock.now_s() + BEGINS_S + 1.3
    rig.sensor.angle_rad = lambda t: swinging(min(t, stands_s))
    result = rig.execute()
    assert result.outcome == "fault"
    assert "no movement for 1 s" in result.reason
    assert rig.stimulator.sent[-1][0] == pytest.approx(stands_s + 1.0, abs=0.05)


def test_a_held_test_may_stand_still(tmp_path: Path):
    rig = held(tmp_path, angle=HELD.model_copy(update={"still_s": 0.5}))
    rig.sensor.noise_deg = 0.0
    assert rig.execute().outcome == "completed"


@pytest.mark.parametrize("rate", [0.8, 1.2])
def test_another_rate_than_the_rig_files_ends_the_test(tmp_path: Path, rate: float):
    rig = held(tmp_path, segments=[*REST, hold(on_s=4.0)])
    rig.sensor.rate = rate
    result = rig.execute()
    assert result.outcome == "fault" and result.reason.startswith("angle sensor: ")
    assert "the rig file says 200" in result.reason or "stale" in result.reason
    assert not rig.stimulator.sent  # told during the rest


def test_no_test_starts_long_after_the_sensor_has_fallen_behind(tmp_path: Path):
    rig = held(tmp_path)
    assert rig.angle is not None
    rig.angle.start()
    for _ in range(200):  # 2 s later in the end, by small steps: it is never silent
        rig.machine.wait(0.02)
        rig.sensor.late_s += 0.01
    rig.machine.wait(10.0)
    assert 1.5 < rig.angle.data_age_s(rig.clock.now_s()) < 2.1
    rig.machine.run(rig.receiver.open())
    result = rig.machine.run(rig.run.execute())
    assert result.outcome == "fault" and "the angle is stale" in result.reason
    assert not rig.stimulator.sent


def test_no_pulse_comes_through_a_passive_test(tmp_path: Path):
    plan = AnglePlan(range_rad=RANGE)
    with pytest.raises(RefusedError, match="passive test"):
        VirtualRig(tmp_path, kind="passive", angle=plan, has_sensor=True)
    rig = VirtualRig(tmp_path, REST, kind="passive", angle=plan, has_sensor=True)
    found: list[PulseStatus] = []
    rig.at(1.31, lambda: found.append(rig.gate.fire(9999, Pulse(100.0, 20.0), math.inf, math.inf)))
    result = rig.execute()
    assert result.outcome == "completed"
    assert found == [PulseStatus.REFUSED]
    assert rig.stimulator.sent == []


def test_enough_ends_a_passive_test_well_and_no_pulse_can_be_added(tmp_path: Path):
    bounds = AdaptivePlan(max_duration_s=60.0, max_torque_time_nms=10.0)
    plan = AnglePlan(range_rad=RANGE)
    rig = VirtualRig(tmp_path, [rest(30.0)], kind="passive", angle=plan, has_sensor=True, adaptive=bounds)
    refused: list[str] = []

    def add() -> None:
        refused.extend(
            map(str, refusals(lambda: extend(rig, len(rig.run.score.queue), [hold(max_pulse_width_us=50.0)])))
        )

    rig.at(1.31, add)
    rig.at(3.01, lambda: rig.run.score.enough("nurse", at_once=True))
    result = rig.execute()
    assert (result.outcome, result.summary["ended_by"]) == ("completed", "enough")
    assert result.summary["duration_s"] == pytest.approx(3.0, abs=0.1)
    assert "passive test" in refused[0] and rig.stimulator.sent == []
    assert rig.test.first_pulse is None


def test_without_angles_a_test_that_needs_them_is_not_armed(tmp_path: Path):
    rig = held(tmp_path)
    rig.sensor.silent = True
    result = rig.execute()
    assert result.outcome == "fault" and result.reason.startswith("angle sensor: no angle arrives")
    assert rig.stimulator.sent == [] and not rig.stimulator.armed


@pytest.mark.parametrize(
    ("kind", "angle", "words"),
    [
        ("moving", None, "plan.angle: a moving test needs it"),
        ("passive", None, "plan.angle: a passive test needs it"),
        ("held", AnglePlan(range_rad=RANGE), "target_rad"),
        ("held", AnglePlan(range_rad=RANGE, target_rad=2.5), "plan.angle.target_rad"),
        ("moving", AnglePlan(range_rad=(1.0, 0.5)), "angle_rad"),
        ("moving", AnglePlan(range_rad=(math.nan, 0.5)), "angle_rad"),
        ("moving", AnglePlan(range_rad=(0.5, math.nan)), "angle_rad"),
        ("held", AnglePlan(range_rad=RANGE, target_rad=math.nan), "plan.angle.target_rad"),
    ],
)
def test_angles_that_do_not_fit_are_refused(tmp_path: Path, kind: str, angle: AnglePlan | None, words: str):
    with pytest.raises((PlanError, RefusedError), match=words):
        VirtualRig(tmp_path, REST, kind=kind, angle=angle)


def test_a_start_away_from_the_target_is_refused(tmp_path: Path):
    rig = held(tmp_path)
    assert rig.angle is not None

    def starts(degrees: float | None, **more: Any) -> None:
        plan = rig.plan.model_copy(update=more)
        rig.angle._recent.clear()
        if degrees is not None:
            rig.sensor.angle_rad = lambda _: math.radians(degrees)
            rig.angle.add(rig.sensor.block(10))
        check_start(rig.angle, plan, limits.for_plan(limits.HARD_LIMITS, plan), rig.clock)

    starts(64.0)
    with pytest.raises(RefusedError, match=r"at 66\.\d°, this test needs 60\.0° ± 5\.2°"):
        starts(66.0)
    with pytest.raises(RefusedError, match=r"12[45]\.\d° is outside 20\.0° … 120\.0° \(request\)"):
        starts(125.0)
    with pytest.raises(DeviceError, match="no angle arrives"):
        starts(None)
    starts(None, angle=None)


@pytest.mark.parametrize(("angle_deg", "said"), [(120.02, "120.020°"), (121.0, "121.0°"), (19.96, "19.960°")])
def test_an_angle_a_hair_beyond_its_range_is_not_told_as_the_end_itself(angle_deg: float, said: str):
    bound = limits.Limit("angle_rad", math.radians(20), math.radians(120), "rad", "", "", "participant's profile")
    assert outside(math.radians(angle_deg), bound) == f"{said} is outside 20.0° … 120.0° (participant's profile)"
