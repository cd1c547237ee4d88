"""A joint that moves, by REST: the sensor's poses, the participant's range, three guided tests, one model of all."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from stimrig.api.models.together import JOINT_EFFECTS
from stimrig.api.services.joint import EffectId, PoseIn, TogetherIn
from stimrig.api.sessions import joint_plan
from stimrig.api.sessions.joint_plan import ENOUGH, Coverage, Curve, curve_of, layout, widths_of
from stimrig.api.sessions.requests import ProfileIn, TestIn
from stimrig.identify.effects import find_effect
from stimrig.identify.fitting import MOVING_JOINT
from stimrig.rig.limits import HARD_LIMITS, for_profile
from stimrig.rig.messages import Profile, TestPlan
from stimrig.rig.plan import build
from tests.api.browser import after_the_end, painted_soon, participant
from tests.api.conftest import Service, own_service, run_test, soon, wait_done
from tests.api.fake_arm import back_and_forth, still
from tests.api.forms import press
from tests.api.test_controller_keys import made
from tests.api.test_problems import problem

RANGE = [math.radians(20), math.radians(110)]


service = own_service(speed=10.0)


@pytest.fixture
def ready(service: Service, client: httpx.Client, participant: str) -> str:
    """A participant with a range, at a rig with a sensor; the joint is still at 65°."""
    service.rig.arm.way = still(math.radians(65))
    soon(lambda: client.get("/v1/rig").json()["angle"]["present"], 20)
    answer = client.put(f"/v1/participants/{participant}/profile", json={"angle_range_rad": RANGE})
    assert answer.status_code == 200, answer.text
    return participant


def begin(client: httpx.Client, code: str, kind: str, **more: Any) -> httpx.Response:
    return client.post("/v1/tests", json={"participant": code, "kind": kind, **more})


# ---- the sensor -----------------------------------------------------------------------------------------------


def test_a_rig_without_a_sensor_says_so_everywhere(client: httpx.Client, participant: str) -> None:
    assert client.get("/v1/rig").json()["angle"]["present"] is False
    client.put(f"/v1/participants/{participant}/profile", json={"angle_range_rad": RANGE})
    asked = [
        client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2}), begin(client, participant, "passive"),
    ]  # fmt: skip
    assert [answer.status_code for answer in asked] == [409] * 2
    assert {answer.json()["type"] for answer in asked} == {"/problems/no-angle-sensor"}
    assert client.get("/v1/rig/angle").json()["present"] is False
    overview = client.get(f"/v1/participants/{participant}/joint").json()
    assert (overview["sensor"]["present"], overview["targets"], overview["doses"]) == (False, [], None)


def test_two_poses_calibrate_and_are_written_down(service: Service, client: httpx.Client, ready: str) -> None:
    service.rig.arm.way = still(0.0)
    first = client.post("/v1/rig/angle/pose", json={"angle_rad": 0.0})
    assert first.status_code == 200 and first.json()["pose"]["angle_rad"] == 0.0 and not first.json()["calibrated"]
    near = client.post("/v1/rig/angle/pose", json={"angle_rad": 0.2})
    assert near.status_code == 422 and "0.5 rad" in near.json()["detail"]
    done = client.post("/v1/rig/angle/pose", json={"angle_rad": 1.5}).json()
    assert done["calibrated"] and done["pose"] is None and done["calibration"]["by"] == "administrator"
    assert client.get("/v1/rig/angle").json()["calibration"]["offset"] == 12.0
    told = [entry for entry in client.get("/v1/audit").json()["entries"] if "angle sensor" in entry["action"]]
    # each is written before the rig is told, and so is the one that was too near
    assert [entry["action"] for entry in told].count("pose of the angle sensor") == 3
    (made,) = [entry for entry in told if entry["action"] == "calibrate the angle sensor"]
    assert (made["subject"], made["detail"]["offset"], len(made["detail"]["poses"])) == ("rig", 12.0, 2)


def test_two_poses_on_the_page_and_the_first_once_more(service: Service, pages: httpx.Client, ready: str) -> None:
    service.rig.arm.way = still(math.radians(15))

    def pose(degrees: float, query: str = "") -> httpx.Response:
        return press(pages, "/rig/angle" + query, "/pose", angle_rad=math.radians(degrees))

    (error,) = problem(pose(200), 422)["errors"]
    assert error == {"field": "angle_rad", "detail": "200° is not within −6° … 138°, as this rig asks"}
    assert pose(51).status_code == 200 and "Second pose" in pages.get("/rig/angle").text, "a slip"
    assert pose(15, "?again=1").status_code == 200 and "The first pose is taken: 15°" in pages.get("/rig/angle").text
    assert pose(100.4).status_code == 200 and "at 15° and 100°" in pages.get("/rig/angle").text


# ---- what is asked for ----------------------------------------------------------------------------------------


WRONG_TESTS: list[dict[str, Any]] = [
    {"kind": "passive", "segments": [{"name": "rest", "sequence": "rest"}]}, {"kind": "held", "protocol": "paper"},
    {"kind": "moving", "target": {"curve_percent": 3}}, {"kind": "held", "max_duration_s": 20},
    {"kind": "passive", "joins": "M1"}, {"kind": "passive", "angle": {"target_rad": 1.0}}, {"angle": {}},
    {"kind": "sequence", "angle": {"target_rad": 1.0}}, {"kind": "held", "angle": {"x": 1}},
    {"kind": "passive", "max_torque_time_nm_s": 3}, {"kind": "moving", "angle": {"still_s": 0}},
]  # fmt: skip
WRONG_RANGES = [[1.0], [1.0, 0.5], [0.2, 0.21], [0.2, "2"], [0.2, 9.0], "x", [0.2, None], [0, 1, 2]]


@pytest.mark.parametrize(
    ("body", "fields"),
    [
        *[(TestIn, {"participant": "P1", **fields}) for fields in WRONG_TESTS],
        *[(ProfileIn, {"angle_range_rad": wrong}) for wrong in WRONG_RANGES],
        *[(PoseIn, {"angle_rad": wrong}) for wrong in ("1.5", None, True, [1.0])],
        *[(TogetherIn, {"recordings": wrong}) for wrong in ([], ["R1", "R1"], ["x"] * 21)],
    ],
)
def test_what_does_not_go_together_is_refused(body: type[BaseModel], fields: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        body.model_validate(fields)


def test_a_range_is_kept_changed_and_taken_away(client: httpx.Client, ready: str) -> None:
    at = f"/v1/participants/{ready}/profile"
    beyond = client.put(at, json={"angle_range_rad": [0.2, 2.8]})
    assert beyond.status_code == 422 and "as this rig asks" in beyond.text
    client.put(at, json={"max_torque_nm": 20.0})
    assert client.get(f"/v1/participants/{ready}").json()["profile"]["angle_range_rad"] == pytest.approx(RANGE)
    assert client.put(at, json={"angle_range_rad": None}).status_code == 200
    assert "angle_range_rad" not in client.get(f"/v1/participants/{ready}").json()["profile"]
    assert begin(client, ready, "passive").json()["type"] == "/problems/no-angle-range"
    page = client.get(f"/participants/{ready}/joint", headers={"Accept": "text/html"}).text
    assert "Set the range first." in page


# ---- the three tests ------------------------------------------------------------------------------------------


def test_a_passive_test_ends_by_itself_once_enough_was_seen(service: Service, client: httpx.Client, ready: str) -> None:
    service.rig.arm.way = back_and_forth(RANGE[0] + 0.01, RANGE[1] - 0.01)
    begun = begin(client, ready, "passive")
    assert begun.status_code == 202, begun.text
    plan = service.rig.last_plan
    assert plan.kind == "passive" and plan.angle.range_rad == pytest.approx(RANGE) and plan.angle.still_s == 8.0
    assert not any(any(segment.settings["pulse_width_us"]) for segment in plan.segments), "no current at all"
    done = wait_done(client, begun.json()["id"])
    assert (done["state"], done["model_id"], done["fit"]) == ("completed", None, None)
    told = done["joint"]
    assert (told["ended"], told["coverage"]["enough"]) == ("covered", True)
    assert done["duration_s"] < 60 < told["longest_s"] == 90.0
    assert service.rig.starts == 1


def test_while_it_runs_it_says_angle_and_what_is_missing(service: Service, client: httpx.Client, ready: str) -> None:
    service.rig.arm.way = back_and_forth(RANGE[0] + 0.01, RANGE[1] - 0.01, (0.4,))  # never fast
    begun = begin(client, ready, "passive", max_duration_s=20)
    kinds, joint, lives = set(), {}, []
    with service.live(begun.json()["id"]) as socket:
        for line in socket:
            message = json.loads(line)
            kinds.add(message["type"])
            if message["type"] == "joint":
                joint = message
                seen = client.get(f"/v1/tests/{begun.json()['id']}").json()["joint"]
                assert seen["state"] in ("watching", "ended")
            if message["type"] == "live":
                lives.append(message)
    assert {"history", "live", "joint", "test"} <= kinds
    assert 0.3 < joint["coverage"]["share"] < 0.9 and not joint["coverage"]["enough"]
    assert any(words.startswith("Bend faster from") for words in joint["words"]), joint["words"]
    assert {each["speed"] for each in joint["coverage"]["missing"]} == {"fast"}
    assert RANGE[0] < lives[-1]["angle_rad"] < RANGE[1] and abs(lives[-1]["velocity_rad_s"]) == 0.4
    done = wait_done(client, begun.json()["id"])
    assert done["joint"]["ended"] == "time" and done["joint"]["coverage"]["share"] == joint["coverage"]["share"]


def test_a_person_may_say_enough(service: Service, client: httpx.Client, ready: str) -> None:
    service.rig.speed = 2.0
    begun = begin(client, ready, "passive").json()["id"]
    assert client.post(f"/v1/tests/{begun}/enough").status_code == 200
    assert wait_done(client, begun)["joint"]["ended"] == "enough"


def test_held_angles_come_one_after_the_other_and_are_remembered(service: Service, client: httpx.Client, ready: str):
    listed = client.get(f"/v1/participants/{ready}/joint").json()
    angles = [row["angle_rad"] for row in listed["targets"]]
    assert len(angles) == 5 and listed["next_rad"] == angles[0]
    away = begin(client, ready, "held")
    assert away.status_code == 422 and "the joint is at" in away.json()["detail"], "it is at the third one"
    for number, angle in enumerate(angles):
        service.rig.arm.way = still(angle + 0.03)
        begun = begin(client, ready, "held")
        assert begun.status_code == 202, begun.text
        assert begun.json()["joint"]["target_rad"] == pytest.approx(angle)
        done = wait_done(client, begun.json()["id"])
        assert (done["state"], done["joint"]["ended"], done["joint"]["coverage"]) == ("completed", "completed", None)
        listed = client.get(f"/v1/participants/{ready}/joint").json()
        assert [row["done"] for row in listed["targets"]] == [k <= number for k in range(5)]
    assert listed["next_rad"] is None
    assert begin(client, ready, "held").json()["type"] == "/problems/all-held"
    assert begin(client, ready, "held", angle={"target_rad": 2.5}).status_code == 422, "beyond the range"
    again = begin(client, ready, "held", angle={"target_rad": angles[-1]})
    assert again.status_code == 202
    wait_done(client, again.json()["id"])


def test_a_stopped_held_test_leaves_its_angle_open(service: Service, client: httpx.Client, ready: str) -> None:
    service.rig.speed = 1.0
    service.rig.arm.way = still(client.get(f"/v1/participants/{ready}/joint").json()["next_rad"])
    begun = begin(client, ready, "held").json()["id"]
    assert client.post("/v1/stop").status_code == 200
    assert wait_done(client, begun)["joint"]["ended"] == "stopped"
    assert not any(row["done"] for row in client.get(f"/v1/participants/{ready}/joint").json()["targets"])


def test_what_is_open_is_told_while_a_test_plays_once_it_was_looked_at(
    service: Service, client: httpx.Client, ready: str
) -> None:
    """The rig previews nothing then: the layout is that of the last look with the same limits."""
    at = f"/v1/participants/{ready}/joint"
    before = client.get(at).json()
    service.rig_thread.become("running")
    assert client.get(at).json()["doses"] == before["doses"]
    client.put(f"/v1/participants/{ready}/profile", json={"max_pulse_width_us": 210.0})
    unknown = client.get(at)
    assert unknown.status_code == 409 and unknown.json()["type"] == "/problems/rig-busy"
    page = client.get(f"/participants/{ready}/joint", headers={"Accept": "text/html"}).text
    assert "a test is in progress; look at the plan afterwards" in page
    service.rig_thread.become("ready")


def test_a_moving_test_counts_under_stimulation_only(service: Service, client: httpx.Client, ready: str) -> None:
    service.rig.arm.way = back_and_forth(RANGE[0] + 0.01, RANGE[1] - 0.01, (0.6, 1.6))
    begun = begin(client, ready, "moving")
    assert begun.status_code == 202, begun.text
    plan = service.rig.last_plan
    widths = [width for segment in plan.segments for width in segment.settings["pulse_width_us"]]
    assert 0 < max(widths) < 300 and plan.angle.still_s == 5.0
    told = wait_done(client, begun.json()["id"])["joint"]
    under_s = sum(width > 0 for width in widths) / plan.pulse_rate_hz
    assert 0 < sum(map(sum, told["coverage"]["time_s"])) < under_s
    assert told["ended"] in ("covered", "torque-time")


def test_the_three_cost_at_most_the_default_test(client: httpx.Client, ready: str) -> None:
    listed = client.get(f"/v1/participants/{ready}/joint").json()
    doses = listed["doses"]
    assert not listed["known"], "no model is approved: nothing but the share is told"
    assert listed["share_of_paper"] == pytest.approx(doses["total"] / doses["paper"]) and listed["share_of_paper"] <= 1
    assert doses["held"] == pytest.approx(5 * doses["held_each"])
    model = run_test(client, ready)["model_id"]
    client.post(f"/v1/models/{model}/approve", json={"reason": ""})
    known = client.get(f"/v1/participants/{ready}/joint").json()
    assert known["known"] and 0.5 < known["share_of_paper"] <= 1.0
    preview = client.post("/v1/preview", json={"participant": ready, "kind": "moving"}).json()
    assert preview["joint"]["doses"] == known["doses"]


SEGMENTS = [{"name": "s", "sequence": "widths", "settings": {"pulse_width_us": [50.0, 100.0, 50.0, 0.0]}}]


@pytest.mark.parametrize("angle", [{}, {"still_s": 2}, None])
def test_a_controllers_trial_can_be_watched(
    service: Service, client: httpx.Client, ready: str, angle: dict[str, Any] | None
) -> None:
    """With `angle` it stops as a guided test does; without, as ever, it takes no notice of the angle."""
    begun = begin(client, ready, "sequence", segments=SEGMENTS, angle=angle)
    assert begun.status_code == 202, begun.text
    plan = service.rig.last_plan.angle
    if angle is None:
        assert plan is None
    else:
        assert plan.range_rad == pytest.approx(RANGE)
        assert (plan.target_rad, plan.still_s) == (None, angle.get("still_s"))
    assert wait_done(client, begun.json()["id"])["joint"] is None, "it is no guided test"


def test_a_range_for_one_trial_only_narrows_also_by_a_controllers_key(
    service: Service, client: httpx.Client, ready: str
) -> None:
    model = run_test(client, ready)["model_id"]
    client.post(f"/v1/models/{model}/approve", json={"reason": ""}).raise_for_status()

    def trial(by: httpx.Client, *range_rad: float) -> httpx.Response:
        return begin(by, ready, "sequence", segments=SEGMENTS, angle={}, profile={"angle_range_rad": range_rad})

    with service.client(made(client, ready)) as key:
        for by in (client, key):
            begun = trial(by, 0.9, 1.3)
            assert begun.status_code == 202, begun.text
            assert service.rig.last_plan.angle.range_rad == pytest.approx((0.9, 1.3))
            wait_done(client, begun.json()["id"])
            assert trial(by, -0.3, 2.5).json()["type"] == "/problems/wider-profile"
    client.put(f"/v1/participants/{ready}/profile", json={"angle_range_rad": None}).raise_for_status()
    invented = trial(client, 0.9, 1.3)
    assert invented.status_code == 422 and "has no range" in invented.json()["detail"]


# ---- one model of all -----------------------------------------------------------------------------------------


@pytest.fixture
def recordings(service: Service, client: httpx.Client, ready: str) -> list[str]:
    service.rig.speed = 40.0
    found = [run_test(client, ready)["recording_id"]]
    service.rig.arm.way = still(client.get(f"/v1/participants/{ready}/joint").json()["next_rad"])
    found.append(wait_done(client, begin(client, ready, "held").json()["id"])["recording_id"])
    return found


def test_one_model_of_several_recordings(client: httpx.Client, ready: str, recordings: list[str]) -> None:
    made = client.post(f"/v1/participants/{ready}/models", json={"recordings": recordings})
    assert made.status_code == 201, made.text
    version = made.json()
    assert version["effects"] == ["passive_torque", "torque_angle", "torque_velocity"]
    assert version["recording_id"].startswith("joined-") and made.headers["Location"] == f"/v1/models/{version['id']}"
    entries = client.get("/v1/audit").json()["entries"]
    (told,) = [entry for entry in entries if entry["action"] == "fit recordings together"]
    assert told["detail"]["recordings"] == recordings
    one = client.post(f"/v1/participants/{ready}/models", json={"recordings": recordings[:1], "effects": []}).json()
    assert (one["recording_id"], one["effects"]) == (recordings[0], [])
    begun = client.post(f"/v1/participants/{ready}/models?wait=false", json={"recordings": recordings})
    assert begun.status_code == 202, "long work may be left alone"
    job = soon(lambda: (found := client.get(begun.headers["Location"]).json())["done"] and found)
    assert (job["kind"], job["participant"], job["model_id"]) == ("fit-recordings", ready, None)
    assert job["result_url"].startswith("/v1/models/")


def test_recordings_without_an_angle_of_others_and_twice_are_refused(
    service: Service, client: httpx.Client, ready: str, recordings: list[str]
) -> None:
    (service.data / "recordings" / "no-angle").touch()
    answer = client.post(f"/v1/participants/{ready}/models", json={"recordings": recordings})
    assert answer.status_code == 422 and f"recording {recordings[1]}: it has no angle_rad" in answer.json()["detail"]
    client.post("/v1/participants", json={"code": "P2"})
    other = client.post("/v1/participants/P2/models", json={"recordings": recordings})
    assert other.status_code == 422 and other.json()["type"] == "/problems/other-participant"
    at = f"/v1/participants/{ready}/models"
    assert client.post(at, json={"recordings": ["nothing"]}).status_code == 404
    assert client.post(at, json={"recordings": recordings, "effects": ["none_such"]}).status_code == 422


# ---- The plans: angles within the range, and never more torque-time than the default test


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
    for segments in (tests.held, tests.moving, [joint_plan.still("passive", 20.0, RATE_HZ)]):
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


# ---- The pages of a moving joint in a real browser: what they follow while a person moves the joint.


LOW, HIGH = math.radians(20), math.radians(110)


@pytest.fixture
def sensor(service: Service) -> Service:
    service.rig.arm.way = still(math.radians(65))
    with service.client() as http:
        soon(lambda: http.get("/v1/rig").json()["angle"]["present"], 30)
    return service


def with_range(tab: Any, service: Service, code: str = "X1") -> None:
    participant(tab, service, code)
    tab.locator("#angle-0").fill("20")
    tab.locator("#angle-1").fill("110")
    with tab.expect_navigation():  # the page is loaded again once they are set
        tab.get_by_role("button", name="Set the limits").click()


def at(tab: Any, service: Service, angle_deg: float) -> None:
    """Move the joint there, and wait until the page knows."""
    service.rig.arm.way = still(math.radians(angle_deg))
    tab.locator('[data-now="angle"]', has_text=f"{angle_deg:.0f}°").first.wait_for()


@pytest.mark.browser
def test_a_passive_test_shows_its_map_and_ends_by_itself(tab: Any, sensor: Service) -> None:
    sensor.rig.speed = 2.0  # it is still slow when a busy machine has loaded its page
    with_range(tab, sensor)
    tab.get_by_role("link", name="To the tests of the joint").click()
    tab.get_by_role("button", name="Start the passive movement…").click()
    tab.get_by_text("none: no current flows").wait_for()
    sensor.rig.arm.way = back_and_forth(LOW + 0.01, HIGH - 0.01)
    tab.get_by_role("button", name="Start now: no stimulation").click()
    tab.wait_for_url("**/tests/T*")
    tab.locator("#missing li", has_text="Bend faster from").wait_for()
    assert "Stimulating" not in tab.locator("#rig-state").inner_text(), "no current flows, so the bar says so"
    assert painted_soon(tab, "angle-chart") and painted_soon(tab, "velocity-chart")
    tab.locator("#coverage td", has_text="✓").first.wait_for()
    assert tab.locator("#angle").inner_text().endswith("°") and tab.locator("#stop").is_visible()
    assert tab.locator("#current").count() == 0, "no current flows, so none is shown"
    after_the_end(tab, "/participants/X1/joint", "Back to the joint")
    tab.locator(".step", has_text="Passive movement").get_by_text("done today").wait_for()
    assert tab.errors == []


@pytest.mark.browser
def test_held_angles_start_only_there_and_survive_a_reload(tab: Any, sensor: Service) -> None:
    sensor.rig.speed = 0.5  # it is still playing when a busy machine has loaded its page
    with_range(tab, sensor)
    tab.goto(f"{sensor.url}/participants/X1/joint")
    start = tab.get_by_role("button", name="Start at 35°…")
    at(tab, sensor, 65)
    assert start.is_disabled()
    at(tab, sensor, 37)
    tab.locator(".held-now.is-there").wait_for()
    start.click()
    tab.get_by_text("Hold at").wait_for()
    at(tab, sensor, 50)
    assert tab.get_by_role("button", name="Start now").is_disabled(), "it left the angle before yes was said"
    at(tab, sensor, 36)
    tab.get_by_role("button", name="Start now").click()
    tab.wait_for_url("**/tests/T*")
    tab.locator("#held", has_text="Hold the joint at").wait_for()
    sensor.rig.speed = 10.0
    after_the_end(tab, "/participants/X1/joint", "Back to the joint")
    tab.get_by_role("button", name="Start at 50°…").wait_for()
    tab.reload()
    assert tab.locator(".angles .is-done").count() == 1 and tab.locator(".angles li").count() == 5
    again = tab.locator(".angles .is-done").get_by_role("button", name="again…")
    at(tab, sensor, 50)
    assert again.is_disabled()
    at(tab, sensor, 35)
    again.click()
    tab.get_by_role("heading", name="Start the held-angle test of X1?").wait_for()
