"""Muscles and records of benches and tests hold what they are made for: the truth about them is true."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench.muscles import arm_records
from bench.muscles.arm_patient import arm_patient
from bench.muscles.bout_records import RAMPS, record_of_bouts
from bench.muscles.hidden_records import generate, main
from bench.muscles.other_physics import SETS, draw_muscle
from bench.muscles.recorders import COUNT_NM, SHIFT_S, recorded
from stimrig.hardware_sim.hidden.chain import Chain

pytestmark = pytest.mark.slow

COLUMNS = ("time_s", "pulse_width_us", "torque_nm", "segment", "angle_rad", "velocity_rad_s")
RATE_HZ, HELD = 1600, 40
"""Steps a second, and those of a pulse's period."""
DRAWN = [
    pytest.param(kinds, place, marks=[pytest.mark.campaign] * (place > 0), id=name)
    for kinds in SETS
    for place, name in enumerate(SETS[kinds])
]
"""One of each set; to compile all takes a minute."""


# ---- hidden effects ----------------------------------------------------------------------------------------------


def test_command_line_writes_records_and_the_truth(tmp_path: Path) -> None:
    arguments = ["--out", str(tmp_path), "--seeds", "310:311", "--effects", "fatigue,none,pairs", "--strengths", "weak"]
    assert main([*arguments, "--rate-hz", "100"]) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert sorted(truth) == sorted(path.name for path in tmp_path.glob("*.csv"))
    assert len(truth) == 3
    assert truth["fatigue-weak-310.csv"]["effects"] == ["fatigue"]
    assert len(truth["pairs-weak-310.csv"]["effects"]) == 2


# ---- recorders ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["counts", "gap+shifted+negative", "real"])
def test_a_recorder_changes_only_what_its_kind_says(kind: str) -> None:
    made = generate(None, seed=330, moving=True, rate_hz=200)
    before = {name: made[name].copy() for name in COLUMNS}
    found = recorded(made, kind, 4)
    told = found["recorder"]
    assert found["truth"] == made["truth"]
    own_s = found["time_s"] - (SHIFT_S if "shifted" in told["kind"] else 0.0) + told["cut_s"]
    rows = np.searchsorted(made["time_s"], own_s - 1e-6)
    assert np.allclose(made["time_s"][rows], own_s)
    for name in COLUMNS:
        assert np.array_equal(made[name], before[name])
        assert found[name].shape == rows.shape
        if name not in ("time_s", "torque_nm"):
            assert np.array_equal(found[name], made[name][rows])
    error = np.abs(found["torque_nm"] - (told["scale"] * made["torque_nm"][rows] + told["offset_nm"])).max()
    assert error < (0.501 * COUNT_NM if "counts" in kind or "real" in kind else 1e-9)
    lost = np.setdiff1d(np.arange(made["time_s"].size), rows)
    assert not np.any(made["segment"][lost] == "validate")
    assert bool(lost.size) == (kind != "counts")


# ---- arms --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 10])
def test_g_is_one_where_the_muscle_is_described_and_everything_is_finite(seed: int) -> None:
    patient = arm_patient(seed)
    assert patient.g(patient.reference_rad, 0.0) == pytest.approx(1.0)
    angle, velocity = np.meshgrid(np.linspace(*patient.range_rad, 30), np.linspace(-3.0, 3.0, 31))
    g, h = patient.g(angle, velocity), patient.h_nm(angle, velocity)
    assert np.all(g[15] >= 0.15) and np.all(g[15] <= 2.0)
    assert np.all((g >= 0.0) & (g < 4.0))
    assert np.all(np.abs(h) < 40.0)
    assert np.all(np.diff(g, axis=0) <= 1e-12), "a flexor that shortens faster gives less torque"
    assert np.all(np.diff(h, axis=0) < 0.0), "viscosity takes torque from whatever moves"


@pytest.mark.parametrize("kind", ["held", "moving"])
def test_an_arms_torque_is_the_contracts_equation_and_white_noise(kind: str) -> None:
    patient = next(each for each in map(arm_patient, range(50)) if "solid" not in each.truth["passive"]["law"])
    made = arm_records.record(patient, kind, 7)
    truth = made["truth"]
    angle, velocity, acceleration = (truth[name] for name in ("angle_rad", "velocity_rad_s", "acceleration_rad_s2"))
    active = patient.g(angle, velocity) * truth["isometric_nm"]
    wanted = active + patient.h_nm(angle, velocity) - patient.inertia_kg_m2 * acceleration
    assert truth["torque_nm"] == pytest.approx(wanted, abs=1e-9)
    noise = made["torque_nm"] - truth["torque_nm"]
    assert noise.std() == pytest.approx(truth["noise_sd_nm"], rel=0.05)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.05


# ---- bouts -------------------------------------------------------------------------------------------------------


def test_readings_are_held_and_the_last_of_four_equal_ramps_is_unseen() -> None:
    made = record_of_bouts(0)
    changes = np.flatnonzero(np.diff(made["torque_nm"])) + 1
    read_hz = made["truth"]["rate_hz"] / np.mean(np.diff(changes))
    assert 18.0 < read_hz < 48.0
    assert np.median(np.abs(np.diff(made["torque_nm"], 3))) == 0.0
    last = int(made["bout"][-1])
    ramps = [made["pulse_width_us"][(made["bout"] == last - back)] for back in range(RAMPS)]
    short = min(map(len, ramps))
    assert all(np.array_equal(ramp[:short], ramps[0][:short]) for ramp in ramps)
    assert np.array_equal(made["segment"] == "validate", made["bout"] == last)


# ---- other physics -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kinds", "place"), DRAWN)
def test_a_muscle_rests_rises_and_decays(kinds: str, place: int) -> None:
    muscle = draw_muscle(kinds, place)
    widths_us = np.r_[np.zeros(80), np.full(120, float(muscle.base.largest_width_us)), np.zeros(600)]
    held, pulse, still = np.repeat(widths_us, HELD), np.zeros(800 * HELD), np.zeros(800 * HELD)
    pulse[::HELD] = widths_us > 0.0
    torque = Chain(muscle.stages(), muscle.base.largest_nm, 1.0 / RATE_HZ).run(held, pulse, still, still)
    assert not torque[: 80 * HELD].any()
    assert 1.79 < np.max(torque) < 9.01
    assert np.argmax(torque) < 205 * HELD
    assert np.max(np.abs(torque[-10 * HELD :])) < 0.2 * np.max(torque)
