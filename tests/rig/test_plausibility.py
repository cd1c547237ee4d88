"""A value that stands still, and a rate that is another than the rig file's: told in the test, however short it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stimrig.rig.acquire.plausibility import PlausibilityCheck
from stimrig.rig.control.sealing import warnings
from stimrig.rig.signals import SAMPLE
from tests.rig.fakes import VirtualRig, hold, rest

pytestmark = pytest.mark.slow


def rig_with_noise(folder: Path, on_s: float, repeats: int = 1, ceiling_nm: float = 5.0) -> VirtualRig:
    """Torque rises to 6 N·m in each hold, above the ceiling."""
    rig = VirtualRig(folder, [hold(on_s=on_s, off_s=1.0, repeats=repeats)])
    rig.cell.noise_nm, rig.cell.ceiling_nm = 0.04, ceiling_nm
    return rig


@pytest.mark.parametrize("sign", [1, -1])  # a cell may be mounted the other way round
def test_a_cell_at_its_ceiling_in_each_hold_goes_on_to_the_end(tmp_path: Path, sign: int):
    rig = rig_with_noise(tmp_path, on_s=2.5, repeats=2)
    rig.cell.sign = sign
    result = rig.execute()
    assert result.outcome == "completed", result.reason
    assert result.summary["torque_peak_nm"] == 5.0


def test_a_cell_that_stays_at_its_ceiling_ends_the_test_within_3_s(tmp_path: Path):
    rig = rig_with_noise(tmp_path, on_s=8.0)
    result = rig.execute()
    assert result.outcome == "fault"
    assert "5.000 N·m" in result.reason and "higher torque is not seen" in result.reason
    assert 3.0 < rig.stimulator.sent[-1][0] - rig.stimulator.sent[0][0] < 4.0  # it takes 0.2 s to get there


@pytest.mark.parametrize(
    ("at_s", "within_s", "ceiling_nm", "words"),
    [(3.7, 3.1, 5.0, "5.000 N·m"), *((at_s, 0.55, 20.0, "it is stuck") for at_s in (0.1, 0.9, 3.05))],
    ids=["at its ceiling", "rising", "high", "falling"],
)
def test_a_cell_that_dies_ends_the_test(tmp_path: Path, at_s: float, within_s: float, ceiling_nm: float, words: str):
    rig = rig_with_noise(tmp_path, on_s=2.0, repeats=3, ceiling_nm=ceiling_nm)
    rig.at(at_s, lambda: setattr(rig.cell, "frozen", True))
    result = rig.execute()
    assert result.outcome == "fault"
    assert words in result.reason
    assert rig.clock.now_s() - rig.stimulator.sent[0][0] < at_s + within_s + 3.5
    assert rig.stimulator.sent[-1][0] - rig.stimulator.sent[0][0] < at_s + within_s


@pytest.mark.parametrize("at_s", [0.3, 4.9])  # before the first pulse, and in a later rest
def test_a_coarse_cell_that_dies_at_rest_is_not_taken_for_one_at_its_end(tmp_path: Path, at_s: float):
    """Of a coarse converter's few codes at rest the least one comes again and again."""
    rig = VirtualRig(tmp_path, [rest(1.0), hold(on_s=2.0, off_s=2.0, repeats=3)])
    rig.cell.noise_nm, rig.cell.step_nm = 0.03, 0.1

    def die() -> None:
        rig.cell.frozen, rig.cell.last_nm = True, -0.1

    rig.at(at_s, die)
    result = rig.execute()
    assert result.outcome == "fault"
    assert "it is stuck" in result.reason
    assert result.summary["duration_s"] < at_s + 0.6


def restless(rig: VirtualRig) -> None:
    """70 ms of every second and a half without a sample: shorter than what counts as silence."""
    rig.cell.noise_nm = 0.01
    rig.cell.held = lambda now_s: now_s % 1.5 < 0.07


@pytest.mark.parametrize("rate", [0.5, 0.94, 1.06, 2.0])
def test_a_short_test_of_a_cell_with_another_rate_is_a_fault(tmp_path: Path, rate: float):
    rig = VirtualRig(tmp_path, [hold(on_s=2.8)])  # shorter than the window in which it would be told at once
    rig.cell.rate, rig.cell.per_block = rate, 10
    result = rig.execute()
    assert result.outcome == "fault"
    told_hz = float(result.reason.removeprefix("load cell: ").split()[0])
    assert told_hz == pytest.approx(1600 * rate, rel=0.02)
    assert "the rig file says 1600" in result.reason
    assert (rig.stimulator.sent == []) == (rate > 1.6)  # so fast it might be a buffer that is emptied: never armed
    assert rig.recording().attributes["outcome"] == "fault"


@pytest.mark.parametrize(
    ("rate", "outcome"), [(0.95, "fault"), (1.05, "fault"), (1.0, "completed"), (1.01, "completed")]
)
def test_a_restless_host_hides_no_rate_and_is_not_taken_for_one(tmp_path: Path, rate: float, outcome: str):
    rig = VirtualRig(tmp_path, [hold(on_s=8.0)])
    rig.cell.rate = rate
    restless(rig)
    began_s = rig.clock.now_s()
    result = rig.execute()
    assert result.outcome == outcome, result.reason
    assert ("samples/s arrive" in result.reason) == (outcome == "fault")
    assert (rig.stimulator.sent[-1][0] - began_s < 4.5) == (outcome == "fault")


def test_a_rig_that_runs_faster_than_the_world_still_sees_half_a_rate(tmp_path: Path):
    """Its window of 3 real seconds is then longer than the test."""
    rig = VirtualRig(tmp_path, [hold(on_s=6.0)])
    rig.clock.speed = 20.0
    rig.cell.rate = 0.5
    result = rig.execute()
    assert result.outcome == "fault"
    assert "800 samples/s arrive" in result.reason


def heard(arrival_s: list[float], size: int = 16) -> list[str | None]:
    """What is said after each block of so many samples, given when each of them came, and at the end."""
    judge = PlausibilityCheck(5.0, 1e9, 1e9, 1600.0, 1.0)
    found = []
    for i, now_s in enumerate(arrival_s):
        block = np.zeros(size, SAMPLE)
        block["counter"], block["host_time_s"], block["torque_nm"] = -1, now_s, i % 2
        found.append(judge.fault(block))
    return [*found, judge.rate.fault_at_end()]


def even(rate: float, count: int = 1000) -> list[float]:
    return [0.01 * number / rate for number in range(count)]


def with_holes(due_s: list[float], every_s: float) -> list[float]:
    """70 ms at the beginning of each so many seconds nothing comes, then all at once."""
    return [max(t_s, every_s * (t_s // every_s) + 0.07) for t_s in due_s]


def piled_up(began_s: float, still_s: float, rate: float) -> list[float]:
    """The host stands still once, then reads quickly what piled up."""
    piled = int(still_s * 100 * 1.25)
    before_s = [0.01 * number for number in range(int(began_s * 100))]
    piled_s = [began_s + still_s + 0.002 * number for number in range(piled)]
    return [t_s / rate for t_s in before_s + piled_s + [began_s + 0.01 * (piled + number) for number in range(800)]]


def read_slowly(*holes_s: tuple[float, float]) -> list[float]:
    """What piled up in the holes is read at 2.5 times the rate."""
    arrival_s: list[float] = []
    for number in range(1400):
        ready_s = max(0.01 * number, arrival_s[-1] + 0.004 if arrival_s else 0.0)
        arrival_s.append(next((end_s for begin_s, end_s in holes_s if begin_s <= ready_s < end_s), ready_s))
    return arrival_s


STOOD = [(0.0, 0.3), (1.0, 2.0), (2.9, 0.3), (2.9, 2.0), (3.5, 0.07)]
HOLES = [(0.5, 1.5), (0.95, 0.5), (0.95, 3.5), (1.0, 0.5), (1.0, 1.5), (1.0, 3.5), (1.05, 1.5), (2.0, 3.5)]
ARRIVALS: dict[str, tuple[list[float], float, float]] = {
    **{f"{rate:g}, stood {one}": (piled_up(*one, rate), rate, 15.0) for one in STOOD for rate in (1.0, 1.05)},
    **{f"{rate:g}, holes {s:g}": (with_holes(even(rate, int(1200 * rate)), s), rate, 4.0) for rate, s in HOLES},
    **{
        f"{rate:g}, in batches": ([np.ceil(t_s / 0.102) * 0.102 for t_s in even(rate, int(1200 * rate))], rate, 15.0)
        for rate in (0.5, 0.9, 1.0, 1.1)
    },
    "read slowly, once": (read_slowly((5.0, 5.9), (5.95, 6.85)), 1.0, 0.0),
    "read slowly, twice": (read_slowly((5.0, 5.5), (5.6, 6.0)), 1.0, 0.0),
    "slower for 1 s": ([t_s + 0.05 * (t_s > 0.65) for t_s in even(1.0, 100)], 1.0, 0.0),
    "slower for 2 s": ([t_s + 0.12 * (t_s > 1.3) for t_s in even(1.0, 200)], 1.0, 0.0),
}
"""When each block came, at which rate, and before when another one than the rig file's is told."""


@pytest.mark.parametrize("name", ARRIVALS)
def test_a_rate_is_told_however_the_samples_come_and_no_other_is_taken_for_one(name: str):
    arrival_s, rate, before_s = ARRIVALS[name]
    told = [(at_s, words) for at_s, words in zip([*arrival_s, arrival_s[-1]], heard(arrival_s), strict=True) if words]
    if rate == 1.0:
        assert told == []
        return
    assert told[0][0] < before_s
    for _, words in told if "stood" in name else told[:1]:
        assert float(words.split()[2]) == pytest.approx(1600 * rate, rel=0.01), words


@pytest.mark.parametrize(("rate", "size"), [(0.05, 4), (0.24, 4), (0.3, 4), (4.5, 4), (0.9, 16)])
def test_a_rate_that_is_another_is_told_at_the_end_of_a_short_test(rate: float, size: int):
    *_, told = heard([i * size / 1600 / rate for i in range(int(2.8 * 1600 / size * rate))], size)
    assert told is not None
    assert float(told.split()[2]) == pytest.approx(1600 * rate, rel=0.01)


@pytest.mark.parametrize(("rate", "every_s"), [(0.5, 3.5), (0.94, 1.5), (0.94, 100.0), (1.06, 3.5)])
def test_a_rate_that_changes_in_the_test_is_told(rate: float, every_s: float):
    held_s = with_holes(even(1.0, 800) + [8.0 + t_s for t_s in even(rate, 500)], every_s)
    told_s = [t_s for t_s, words in zip(held_s, heard(held_s), strict=False) if words]
    assert 8.0 < told_s[0] < 12.0


def test_a_backlog_read_while_arming_does_not_end_the_test(tmp_path: Path):
    rig = VirtualRig(tmp_path, [hold(on_s=8.0)])
    rig.cell.noise_nm, rig.cell.rate = 0.01, 2.0  # for 2 s old samples come so fast: the rig waits for the fresh ones
    rig.clock.call_at(rig.clock.now_s() + 2.0, lambda: setattr(rig.cell, "rate", 1.0))
    result = rig.execute()
    assert result.outcome == "completed", result.reason


def test_times_in_doubt_are_told_with_the_finished_test(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.execute()
    recording = rig.recording()
    assert warnings(recording) == []
    for error_ms, words in ((60.0, "60.0 ms"), (float("nan"), "unknown")):
        doubtful = replace(recording.alignment, method="sync", error_ms=error_ms)
        assert words in warnings(replace(recording, alignment=doubtful))[0]
    recording.columns["torque/torque_nm"][:] = 1.25
    assert "stayed at exactly 1.250" in warnings(recording)[0]
    recording.columns["torque/torque_nm"][3] = 1.5
    recording.attributes["sample_rate_measured_hz"] = 1560.0
    assert "1560 samples/s arrived, the rig file says 1600" in warnings(recording)[0]
