"""The guided tests of a joint that moves: angles within the range, and never more torque-time than the paper's test."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest
from pydantic import TypeAdapter

from stimrig.api.models.together import JOINT_EFFECTS
from stimrig.api.services.joint import EffectId
from stimrig.api.sessions.joint_plan import ENOUGH, Coverage, Curve, curve_of, layout, still, widths_of
from stimrig.identify.effects import find_effect
from stimrig.identify.fitting import MOVING_JOINT
from stimrig.rig.limits import HARD_LIMITS, for_profile
from stimrig.rig.messages import Profile, TestPlan
from stimrig.rig.plan import build

RATE_HZ = 40.0
TEST = TestPlan(
    test_id="T1", participant="P1", profile=Profile(current_ma=20, max_pulse_width_us=300, max_torque_nm=30)
)
LIMITS = for_profile(HARD_LIMITS, TEST.profile)
PAPER_US = build(TEST, LIMITS).pulse_width_us.tolist()


def sigmoid(middle_us: float, steep_us: float, top_nm: float) -> dict[str, list[float]]:
    widths = [5.0 * k for k in range(61)]
    raw = [1 / (1 + math.exp(-(u - middle_us) / steep_us)) for u in widths]
    return {"pulse_width_us": widths, "torque_nm": [top_nm * (r - raw[0]) / (1 - raw[0]) for r in raw]}


def test_without_a_model_the_calibration_stands_in() -> None:
    curve = curve_of(None, 300.0, 120.0)
    assert not curve.known and curve.torque(120.0) == 0.0 and curve.torque(210.0) == pytest.approx(0.5)
    tests = layout((0.2, 1.9), curve, 300.0, PAPER_US, RATE_HZ)
    widths = [width for width in widths_of(tests.held) if width]
    assert tests.share <= 1.0 and min(widths) < 165 <= max(widths) <= 256
    assert curve_of(None, 300.0, None).torque(90.0) == 0.0
    assert not curve_of({"pulse_width_us": [0, 300], "torque_nm": [0, 0]}, 300.0, None).known, "a muscle that is dead"


def test_the_plans_pass_the_rigs_limits() -> None:
    """Built as the rig builds them: no jump that startles, nothing above the widest pulse."""
    tests = layout((0.2, 1.9), curve_of(sigmoid(150, 25, 8.0), 300.0, None), 300.0, PAPER_US, RATE_HZ)
    for segments in (tests.held, tests.moving, [still("passive", 20.0, RATE_HZ)]):
        plan = TestPlan.model_validate({**TEST.model_dump(), "segments": segments})
        assert build(plan, LIMITS).pulse_width_us.tolist() == pytest.approx(widths_of(segments))


def test_the_inverse_is_the_smallest_width() -> None:
    curve = Curve((100.0, 200.0, 300.0), (0.0, 4.0, 4.0), True)
    assert curve.width(2.0, 300.0) == 150.0 and curve.width(4.0, 300.0) == 200.0 and curve.width(9.0, 250.0) == 250.0


def test_the_effects_of_a_moving_joint_are_those_of_identify_and_may_be_asked_for() -> None:
    assert JOINT_EFFECTS == MOVING_JOINT
    for name in JOINT_EFFECTS:
        assert TypeAdapter(EffectId).validate_python(name) == name
        effect, _, forms = name.partition(":")
        assert [find_effect(effect).form(form).name for form in forms.split("|")] == forms.split("|")


SAMPLES_HZ = 200.0
RANGE_RAD = (math.radians(20), math.radians(110))
Sample = tuple[float, float, float]


def sweep(speed_rad_s: float, begin_s: float = 0.0) -> Iterator[Sample]:
    """Twice from end to end of the range and back, at one speed."""
    low, high = RANGE_RAD[0] + 0.01, RANGE_RAD[1] - 0.01
    time_s = begin_s
    for start, end in ((low, high), (high, low)) * 2:
        count = round(abs(end - start) / speed_rad_s * SAMPLES_HZ)
        for k in range(count):
            yield time_s, start + (end - start) * k / count, math.copysign(speed_rad_s, end - start)
            time_s += 1 / SAMPLES_HZ


SLOW, FAST = list(sweep(0.4)), list(sweep(1.2, 60.0))


def covered(samples: list[Sample], counts: Callable[[Sample], bool] = lambda _: True) -> Coverage:
    coverage = Coverage(RANGE_RAD, 0.2)
    for sample in samples:
        coverage.add(*sample, counts(sample))
    return coverage


def test_columns_lie_within_the_range() -> None:
    cells = Coverage(RANGE_RAD, 0.2)
    assert cells.columns == 5
    assert RANGE_RAD[0] < cells.edges_rad[0] < cells.edges_rad[-1] < RANGE_RAD[1]
    assert [Coverage((0.0, width), 0.2).columns for width in (0.3, 0.9, 6.0)] == [3, 3, 8]


def test_slow_alone_leaves_the_fast_ones_missing_and_both_are_enough() -> None:
    coverage = covered(SLOW)
    assert not coverage.enough and 0.4 < coverage.share < ENOUGH
    missing = [(each["direction"], each["speed"]) for each in coverage.missing()]
    assert missing == [("flexion", "fast"), ("extension", "fast")]
    coverage = covered(SLOW + FAST)
    assert coverage.share == 1.0 and coverage.enough and coverage.missing() == []


def test_a_small_movement_misses_the_ends_in_one_stretch_each() -> None:
    middle, times = sum(RANGE_RAD) / 2, [k / SAMPLES_HZ for k in range(4000)]
    coverage = covered([(t, middle + 0.1 * math.sin(4 * t), 0.4 * math.cos(4 * t)) for t in times])
    slow = [each for each in coverage.missing() if (each["direction"], each["speed"]) == ("flexion", "slow")]
    assert len(slow) == 2 and slow[0]["to_rad"] <= middle <= slow[1]["from_rad"]
    assert coverage.missing()[0]["speed"] == "slow", "what is to be done first comes first"


def test_a_cell_is_seen_after_its_time_and_not_before() -> None:
    samples = [(k / SAMPLES_HZ, 1.0, 0.4) for k in range(41)]
    assert not covered(samples[:-1]).covered.any() and covered(samples).covered.sum() == 1


@pytest.mark.parametrize(
    "odd", [(math.nan, 1.0, 0.4), (0.01, math.nan, 0.4), (0.01, 1.0, math.inf), (-5.0, 1.0, 0.4), (9.0, 1.0, 0.4)]
)
def test_no_number_a_gap_or_a_step_back_counts_for_nothing(odd: Sample) -> None:
    assert not any(map(sum, covered([(0.0, 1.0, 0.4), odd]).time_s))


def test_what_does_not_count_is_passed_over() -> None:
    """Under stimulation only: the pauses between two levels say nothing of the muscle. Nor does a joint at rest."""
    assert covered(SLOW + FAST, lambda _: False).share == 0.0
    only_flexion = covered(SLOW + FAST, lambda sample: sample[2] > 0)
    assert {each["direction"] for each in only_flexion.missing()} == {"extension"}
    assert covered([(k / SAMPLES_HZ, 1.0, 0.0) for k in range(2000)]).share == 0.0


def test_the_document_says_it_all() -> None:
    document = covered(SLOW).document()
    columns = len(document["angle_edges_rad"]) - 1
    assert [len(row) for row in document["time_s"]] == [columns] * 5 == [len(row) for row in document["asked"]]
    assert len(document["velocity_edges_rad_s"]) == 4 and 0 < document["share"] < 1 and not document["enough"]
    assert set(document["missing"][0]) == {"direction", "speed", "from_rad", "to_rad"}
