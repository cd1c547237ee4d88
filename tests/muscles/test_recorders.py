"""Recorders change the record and not the muscle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.muscles.hidden_records import generate
from bench.muscles.recorders import COUNT_NM, KINDS, SHIFT_S, recorded

COLUMNS = ("time_s", "pulse_width_us", "torque_nm", "segment", "angle_rad", "velocity_rad_s")


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    return generate(None, seed=330, moving=True, rate_hz=200)


def rows_kept(made: dict[str, Any], found: dict[str, Any]) -> np.ndarray:
    """Which rows of the record made are left, by their time."""
    told = found["recorder"]
    shift = SHIFT_S if "shifted" in told["kind"] else 0.0
    rows = np.searchsorted(made["time_s"], found["time_s"] - shift + told["cut_s"] - 1e-6)
    assert np.allclose(made["time_s"][rows], found["time_s"] - shift + told["cut_s"])
    return rows


@pytest.mark.parametrize("seed", [4, 5])
@pytest.mark.parametrize("kind", [*KINDS, "gap+shifted+negative", "real+gap"])
def test_only_what_the_kind_says_is_changed(made: dict[str, Any], kind: str, seed: int) -> None:
    before = {name: made[name].copy() for name in COLUMNS}
    found = recorded(made, kind, seed)
    assert found["truth"] == made["truth"]
    rows, told = rows_kept(made, found), found["recorder"]
    for name in COLUMNS:
        assert np.array_equal(made[name], before[name])
        assert found[name].shape == rows.shape
        if name not in ("time_s", "torque_nm"):
            assert np.array_equal(found[name], made[name][rows])
    error = np.abs(found["torque_nm"] - (told["scale"] * made["torque_nm"][rows] + told["offset_nm"])).max()
    assert error < (0.501 * COUNT_NM if "counts" in kind or "real" in kind else 1e-9)
    lost = np.setdiff1d(np.arange(made["time_s"].size), rows)
    assert not np.any(made["segment"][lost] == "validate")
    if kind in ("plain", "offset", "counts", "negative", "scaled", "shifted"):
        assert not lost.size
    if kind == "plain":
        assert np.array_equal(found["torque_nm"], made["torque_nm"])
    again = recorded(made, kind, seed)
    assert all(np.array_equal(again[name], found[name]) for name in COLUMNS)


def test_a_real_recorder_does_it_all(made: dict[str, Any]) -> None:
    even, odd = (recorded(made, "real", seed) for seed in (4, 5))
    assert (even["recorder"]["scale"], odd["recorder"]["scale"]) == (1.0, -1.0)
    for found in (even, odd):
        assert 0.0 < abs(found["recorder"]["offset_nm"]) <= 12.0
        counts = found["torque_nm"] / COUNT_NM
        assert np.allclose(counts, np.round(counts), atol=1e-6)
        assert found["time_s"][0] == 0.0
        assert found["segment"][0] == "prbs" and found["pulse_width_us"][0] > 0.0
        assert 2.5 <= found["recorder"]["cut_s"] <= 5.0  # the PRBS begins at 2 s


def test_two_gaps_and_two_scales(made: dict[str, Any]) -> None:
    found = recorded(made, "gap", 4)
    steps = np.diff(found["time_s"])
    assert np.sum(steps > 0.2) == 2
    assert np.all((steps < 0.0051) | ((steps > 0.29) & (steps < 1.51)))
    assert [abs(recorded(made, "scaled", seed)["recorder"]["scale"]) for seed in (4, 5)] == [0.1, 10.0]


def test_an_unknown_recorder_is_refused_with_those_there_are(made: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="shifted"):
        recorded(made, "reversed", 4)
    with pytest.raises(ValueError, match="prbs"):
        recorded({**made, "segment": np.full(made["time_s"].size, "ramp")}, "start", 4)
