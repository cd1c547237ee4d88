"""A value that stands still: a dead cell ends the test at once, one at its ceiling only if it stays there too long."""

from __future__ import annotations

from pathlib import Path

import pytest

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
